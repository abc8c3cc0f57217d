"""An optimisation: trials of a design are asked of Optuna in batches, run on an engine, and told."""

import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
from optuna.samplers import BaseSampler, NSGAIISampler, TPESampler
from optuna.samplers.nsgaii import PolynomialMutation, SBXCrossover
from optuna.storages.journal import JournalFileBackend, JournalStorage
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState

from hil.engine.batches import fingerprint
from hil.engine.engine import Engine
from hil.sweep.case import GEOMETRY_FIGURE, case_of, mechanism_at
from hil.sweep.design import MINIMISE, Design
from hil.sweep.store import Store
from hil.sweep.study import Factor
from hil.sweep.sweep import Report, no_report
from hil.sweep.trials import Comparison, Outcome, TrialRunner, breaks_geometry, compare, violations
from plant.compiled import hash_of_files
from plant.errors import InputError
from plant.files import write_whole
from plant.mechanism.documents import mechanism_document, mechanism_from_text, mechanism_text
from plant.mechanism.joint_circles import shape_of

TRIALS = "trials.log"
"""Optuna's storage, a journal, in the folder of the results."""
RUN, GIVEN_UP, REFUSED = "run", "given up", "refused"
"""What became of a trial: all its runs are there; it was worse than the best; it breaks a bound or cannot be run."""
_WHOLE = "whole"
_P_OF_GIVING_UP = 0.1


@dataclass(frozen=True)
class Trial:
    """A trial.

    Attributes:
        number: from 0.
        point: the factors' values.
        figures: the objectives' and constraints' figures that are known, pooled over seeds.
        state: run, given up or refused.
        reason: why it is refused; "" otherwise.
    """

    number: int
    point: Mapping[str, Any]
    figures: Mapping[str, float]
    state: str
    reason: str


@dataclass(frozen=True, eq=False)
class OptimisationResult:
    """What an optimisation has found.

    Attributes:
        folder: where its results are.
        start: the figures of the design as it is; none of a model.
        trials: all of them.
        front: of those that keep the constraints, the ones that no other beats in all objectives, by the first objective.
        ran: the runs that were not there before.
        study: Optuna's own view.
    """

    design: Design
    folder: Path
    start: Mapping[str, float]
    trials: tuple[Trial, ...]
    front: tuple[Trial, ...]
    ran: int
    study: optuna.Study

    def objectives_of(self, trials: Sequence[Trial]) -> np.ndarray[Any, np.dtype[np.float64]]:
        """The objectives (N, objectives) of trials."""
        return np.array([[trial.figures[each.figure] for each in self.design.objectives] for trial in trials], np.float64)

    @property
    def knee(self) -> Trial:
        """The trial of the front that is nearest to the best of all objectives, each as a share of its range over the front;
        for one objective the best.

        Raises:
            InputError: the front is empty.
        """
        if not self.front:
            raise InputError(f"none of {len(self.trials)} trials keeps the constraints: {self._refusals()}")
        values = self.objectives_of(self.front) * [each.sign for each in self.design.objectives]
        span = np.ptp(values, axis=0)
        shares = (values - values.min(axis=0)) / np.where(span > 0.0, span, 1.0)
        return self.front[int(np.argmin(np.linalg.norm(shares, axis=1)))]

    def chosen(self, which: str = "knee") -> Trial:
        """The trial of the front with a number, the "knee", or the "first", which is the best in the first objective.

        Raises:
            InputError: no trial of the front has this number.
        """
        if which == "knee":
            return self.knee
        known = {str(trial.number): trial for trial in self.front}
        if self.front:
            known["first"] = self.front[0]
        if which not in known:
            raise InputError(f"{which!r} is not on the front; on it are knee, {', '.join(known) or 'no trials'}")
        return known[which]

    def summary(self) -> dict[str, Any]:
        """The front, the start, and how many trials there are, for JSON."""
        states = [trial.state for trial in self.trials]
        return {
            "design": self.design.study.name,
            "objectives": [asdict(each) for each in self.design.objectives],
            "constraints": [asdict(each) for each in self.design.constraints],
            "method": self.design.method,
            "start": dict(self.start),
            "front": [asdict(trial) for trial in self.front],
            "knee": self.knee.number if self.front else None,
            "trials": {state: states.count(state) for state in (RUN, GIVEN_UP, REFUSED)},
            "new_runs": self.ran,
            "sources": fingerprint(),
            "version": version("gough"),
        }

    def _refusals(self) -> str:
        return next((trial.reason for trial in self.trials if trial.reason), "loosen them")


def optimise(design: Design, folder: Path, engine: Engine, progress: Report = no_report) -> OptimisationResult:
    """Try the trials of a design that are not in a folder yet.

    The trials depend on the design and its seed alone, neither on the engine nor on interruptions.

    Args:
        design: what is looked for.
        folder: where the results are, or will be: a table of all runs, and Optuna's storage.
        engine: where to run.
        progress: called with the share that is done, and what is going on in words.

    Raises:
        GoughError: the design or the folder cannot be used, none of the first trials can be run, or the engine's workers
            have gone.
    """
    with Store.opened(folder) as store, quiet():
        done, wanted = 0, design.search.trials

        def tell() -> None:
            progress(done / wanted, f"{done} of {wanted} trials, {runner.rate:.3g} runs a second")

        runner = TrialRunner(design, engine, store, tell)
        start = runner.start()
        saved = _saved(design, folder)
        study = optuna.create_study(directions=_directions(design), pruner=_pruner(design))
        kept = saved.get_trials(deepcopy=False)
        study.add_trials(kept[: saved.user_attrs.get(_WHOLE, 0)])
        count_saved = len(kept)
        _remember_parents(design, study)
        if not study.trials and (first := _start_point(design)):
            study.enqueue_trial(first)
        while (done := len(_finished(study))) < wanted:
            tell()
            study.sampler = _sampler(design, done)
            count = min(design.batch - done % design.batch, wanted - done)
            batch = [study.ask(_distributions(design)) for _ in range(count)]
            outcomes = _try(runner, study, batch, start)
            if not done and all(outcome.reason for outcome in outcomes):
                raise InputError(f"none of the first {count} trials can be run; the first one: {outcomes[0].reason}")
            # A process that died here may have saved a part of the batch, and has asked for the same trials.
            saved.add_trials(_finished(study)[count_saved:])
            count_saved = max(count_saved, done + count)
            saved.set_user_attr(_WHOLE, done + count)
        progress(1.0, f"{wanted} trials")
    trials = tuple(_trial(design, trial) for trial in _finished(study))
    best = [trials[trial.number] for trial in study.best_trials] if len(trials) else []
    front = sorted(best, key=lambda trial: [each.sign * trial.figures[each.figure] for each in design.objectives])
    return OptimisationResult(design, folder, start, trials, tuple(front), runner.ran, study)


def check(result: OptimisationResult, trial: Trial, engine: Engine, progress: Report = no_report) -> list[Comparison]:
    """Compare a trial with the start on the runs of the design's check, which the search did not use; none without seeds.

    Raises:
        GoughError: one of the two cannot be run, or the engine's workers have gone.
    """
    if not result.design.check.seeds:
        return []
    with Store.opened(result.folder) as store:
        runner = TrialRunner(
            result.design, engine, store, lambda: progress(0.0, f"check: {runner.ran} runs, {runner.rate:.3g} a second")
        )
        return compare(runner, trial.point)


def mechanism_of(result: OptimisationResult, trial: Trial) -> str:
    """The mechanism of a trial as a TOML text, with what else the trial varies as comments.

    Raises:
        GoughError: the design has a model in place of a mechanism.
    """
    import tomlkit

    design = result.design
    if design.study.model is not None:
        raise InputError("a model has no mechanism that could be written")
    content = mechanism_at(design.study, trial.point)
    name = design.study.config_at(trial.point).mechanism
    document = tomlkit.parse(content.decode() if content is not None else mechanism_text(name))
    document["name"] = f"{Path(name).stem}, {design.study.name}"
    lines = [f"{design.study.name!r}, trial {trial.number} of gough optimise {version('gough')}; units are SI."]
    lines += [f"{factor} = {value}" for factor, value in trial.point.items()]
    lines += [f"{figure}: {value:.6g}" + _beside(result.start.get(figure)) for figure, value in trial.figures.items()]
    return "\n".join(f"# {line}" for line in lines) + f"\n\n{tomlkit.dumps(document).lstrip()}"


def _beside(start: float | None) -> str:
    return "" if start is None else f" (as it was: {start:.6g})"


def _try(runner: TrialRunner, study: optuna.Study, batch: Sequence[optuna.Trial], start: Mapping[str, float]) -> list[Outcome]:
    """Run a batch of trials, and tell Optuna."""
    design = runner.design
    outcomes = [Outcome(_point(design, trial.params)) for trial in batch]
    runner.measure_geometry(outcomes)
    for outcome in outcomes:
        outcome.left = outcome.left and not breaks_geometry(design, outcome, start)
    given_up = _run(runner, batch, outcomes)
    for trial, outcome in zip(batch, outcomes, strict=True):
        figures = outcome.figures(design)
        trial.set_user_attr("figures", figures)
        trial.set_user_attr("reason", outcome.reason)
        for name, violation in violations(design, outcome, start).items():
            trial.set_constraint(name, violation)
        if trial.number in given_up:
            study.tell(trial, state=TrialState.PRUNED)
        else:
            worst = [each.sign * np.inf for each in design.objectives]
            study.tell(trial, [figures[each.figure] for each in design.objectives] if outcome.left else worst)
    return outcomes


def _run(runner: TrialRunner, batch: Sequence[optuna.Trial], outcomes: Sequence[Outcome]) -> set[int]:
    """The runs of a batch; returns the numbers of the trials that were given up before their last runs."""
    design, given_up = runner.design, set()
    runs, objective = len(design.points_of({})), design.objectives[0].figure
    size = design.search.group if len(design.objectives) == 1 else runs
    for first in range(0, runs, size):
        runner.measure_runs(outcomes, partial(_group, design, slice(first, first + size)))
        for trial, outcome in zip(batch, outcomes, strict=True):
            if runs > size and outcome.left and not objective.startswith(GEOMETRY_FIGURE):
                for step, value in enumerate(outcome.values[objective][first:], start=first):
                    trial.report(value, step)
                if first + size < runs and trial.should_prune():
                    given_up.add(trial.number)
                    outcome.left = False
    return given_up


def _group(design: Design, group: slice, point: Mapping[str, Any]) -> list[dict[str, Any]]:
    return design.points_of(point)[group]


def _trial(design: Design, trial: FrozenTrial) -> Trial:
    figures, reason = trial.user_attrs["figures"], trial.user_attrs["reason"]
    broken = [name for name, value in trial.constraints.items() if value > 0.0]
    state = GIVEN_UP if trial.state == TrialState.PRUNED else REFUSED if broken else RUN
    if broken and not reason:
        reason = f"out of its bounds: {', '.join(broken)}"
    return Trial(trial.number, _point(design, trial.params), figures, state, reason)


def _finished(study: optuna.Study) -> list[FrozenTrial]:
    return study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED))


def _directions(design: Design) -> list[StudyDirection]:
    return [StudyDirection.MINIMIZE if each.goal == MINIMISE else StudyDirection.MAXIMIZE for each in design.objectives]


def _saved(design: Design, folder: Path) -> optuna.Study:
    """Optuna's study of this very design in a folder, where others may be, too."""
    path = folder / TRIALS
    path.with_name(f"{TRIALS}.lock").unlink(missing_ok=True)  # of a process that died: the store is ours
    if path.exists() and not (content := path.read_bytes()).endswith(b"\n"):
        write_whole(path, content[: content.rfind(b"\n") + 1])
    about = {
        "start": case_of(design.study, {}, design.of_run, design.of_geometry).key,
        "factors": [asdict(factor) for factor in design.study.factors],
        "objectives": [asdict(each) for each in design.objectives],
        "constraints": [asdict(each) for each in design.constraints],
        "search": {**asdict(design.search), "trials": None},
        "optuna": optuna.__version__,
    }
    name = hash_of_files([], json.dumps(about, sort_keys=True, default=str))
    return optuna.create_study(
        study_name=name, storage=JournalStorage(JournalFileBackend(str(path))), directions=_directions(design),
        load_if_exists=True,
    )  # fmt: skip


def _sampler(design: Design, done: int) -> BaseSampler:
    """A sampler whose draws depend on the design's seed and the trials before alone."""
    seed = int(np.random.SeedSequence([design.search.seed, done]).generate_state(1)[0])
    if design.method == "tpe":
        return TPESampler(seed=seed, n_startup_trials=max(10, 2 * design.batch))
    crossover = SBXCrossover(eta=5.0, uniform_crossover_prob=0.0, use_child_gene_prob=1.0)
    return NSGAIISampler(population_size=design.batch, seed=seed, crossover=crossover, mutation=PolynomialMutation(20.0))


def _remember_parents(design: Design, study: optuna.Study) -> None:
    """Select the parents of all generations again, one after the other as without an interruption.

    NSGA-II would do it backwards, and then breaks ties otherwise.
    """
    sampler = _sampler(design, 0)
    if isinstance(sampler, NSGAIISampler):
        for generation in range(1, -(-len(study.trials) // design.batch)):
            sampler.get_parent_population(study, generation)


def _pruner(design: Design) -> optuna.pruners.BasePruner:
    """Gives a trial up when a signed-rank test over the seeds says that it is worse than the best one."""
    if len(design.objectives) > 1 or design.method != "tpe":
        return optuna.pruners.NopPruner()
    return optuna.pruners.WilcoxonPruner(p_threshold=_P_OF_GIVING_UP)


def _distributions(design: Design) -> dict[str, BaseDistribution]:
    return {
        factor.name: FloatDistribution(factor.low, factor.high, log=factor.logarithmic)
        if factor.sampled
        else CategoricalDistribution([_choice(value) for value in factor.values])
        for factor in design.study.factors
    }


def _choice(value: Any) -> Any:
    """A value as Optuna keeps it."""
    return value if isinstance(value, str | bool | int | float) else json.dumps(value)


def _point(design: Design, params: Mapping[str, Any]) -> dict[str, Any]:
    """The factors' values of a trial."""
    return {
        factor.name: params[factor.name]
        if factor.sampled
        else next(value for value in factor.values if _choice(value) == params[factor.name])
        for factor in design.study.factors
    }


def _start_point(design: Design) -> dict[str, Any]:
    """The values that the factors have where nothing varies, as far as they are known and within their bounds."""
    study = design.study
    if study.model is not None:
        return {}
    name, content = study.run.mechanism, mechanism_at(study, {})
    text = mechanism_text(name) if content is None else content.decode()
    values: dict[str, Any] = {f"run.{each.name}": getattr(study.run, each.name) for each in fields(study.run)}
    if any(factor.name.startswith("geometry.") for factor in study.factors):
        mechanism = mechanism_from_text(text, name)
        values |= {f"geometry.{entry}": value for entry, value in shape_of(mechanism).items()}
    document = mechanism_document(text, name)
    values |= {f.name: _entry(document, f.name.partition(".")[2]) for f in study.factors if f.name.startswith("mechanism.")}
    return {
        factor.name: values[factor.name] if factor.sampled else _choice(values[factor.name])
        for factor in study.factors
        if factor.name in values and _within(factor, values[factor.name])
    }


def _entry(document: Any, entry: str) -> Any:
    """An entry of nested tables by its name with dots; None if there is none."""
    for part in entry.split("."):
        if not isinstance(document, dict) or part not in document:
            return None
        document = document[part]
    return document


def _within(factor: Factor, value: Any) -> bool:
    if factor.sampled:
        return isinstance(value, int | float) and factor.low <= value <= factor.high
    return any(each == value for each in factor.values)


@contextmanager
def quiet() -> Iterator[None]:
    """Keep Optuna quiet, which tells of every trial, and that some of its parts are young."""
    level = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            yield
    finally:
        optuna.logging.set_verbosity(level)
