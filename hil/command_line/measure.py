"""The command bench."""

from argparse import Namespace
from typing import Any

from hil.command_line import cli
from hil.command_line.terminal import QUANTILES, progress_bar
from hil.table import Table
from plant.errors import InputError

_SECTIONS = ("clock", "panel", "loop", "plant", "kinematics", "workspace")


@cli.command(
    cli.setting("--duration", 60.0, "duration of the simulated motion [s]"),
    cli.setting("--target", "sines", "motion or CSV file"),
    cli.argument(
        "--only", choices=_SECTIONS, nargs="+", default=_SECTIONS, metavar="SECTION",
        help=f"some sections instead of all: {', '.join(_SECTIONS)}",
    ),
    cli.setting(
        "--clock", 10.0, "time on the clock at 1 kHz, idle and again under load; 4 kHz gets a third [s]", metavar="SECONDS"
    ),
    cli.argument(
        "--measures", type=float, metavar="SECONDS", help="also try the loop without each measure for real time, for this time"
    ),
    cli.setting("--panel", 60.0, "time on the clock without a panel, and as long with one [s]", metavar="SECONDS"),
    cli.flag("--cold", "measure the start without caches, too (a minute)"),
    cli.flag("--check", "fail if the loop on the clock is off by more than any noise, or a panel costs more than its limits"),
    cli.report("write histograms of the loop on the clock, and without and with a panel"),
    cli.source("--history", "FILE.json", "earlier figures for the report", nargs="+", default=[]),
    cli.JSON,
)  # fmt: skip
def gough_bench(options: Namespace) -> None:
    """Measure the loop, the plant and the kinematics: their speed and lateness.

    The loop on the clock: how late it wakes, beside cyclictest, and how long it computes, idle, under load and with a busy
    supervisor; the same without and with a panel, and what that takes of a processor; the loop's speed against real time and
    the microseconds of each stage; the plant's FMU, from compiled code and through FMPy, and how exact it is; direct
    kinematics: microseconds per pose, against Newton's method from lengths, here and in C, and whether both find the pose from
    cold; and the margins of a pose in the workspace, against inverse kinematics.
    """
    from hil.benchmarks.loop import machine, read_earlier

    for name, seconds in (("--clock", options.clock), ("--panel", options.panel), ("--measures", options.measures)):
        if seconds is not None and not 0.0 < seconds < float("inf"):
            raise InputError(f"{name} is {seconds:g} s; it must be positive and finite")
    earlier = [read_earlier(path) for path in options.history]
    figures: dict[str, Any] = machine()
    measures = (_clock, _panel, _loop, _plant, _kinematics, _workspace)
    for section, measure in zip(_SECTIONS, measures, strict=True):
        if section in options.only:
            measure(options, figures)
    cli.write_json(options.json, figures)
    cli.write_report(options, "benchmark", figures, earlier)
    print(f"{figures['machine']}, {figures['date']}, gough {figures['version']}")
    if options.check:
        from hil.benchmarks.clock import GrossExcessError, gross_excess
        from hil.benchmarks.panel import panel_excess

        excess = gross_excess(figures["real_time"]) if "real_time" in figures else []
        if excess := excess + (panel_excess(figures["panel"]) if "panel" in figures else []):
            raise GrossExcessError(f"in gross excess: {'; '.join(excess)}")


def _clock(options: Namespace, figures: dict[str, Any]) -> None:
    from hil.benchmarks.clock import measure_measures, measure_real_time, measure_start_up

    with progress_bar("the loop on the clock") as progress:
        start_up = figures["start_up"] = measure_start_up(options.cold)
        real_time = figures["real_time"] = measure_real_time({1000.0: options.clock, 4000.0: options.clock / 3.0}, progress)
    for rate, conditions in real_time["rates"].items():
        for condition, measured in conditions.items():
            _print_condition(f"{rate} Hz, {condition.replace('_', ' ')} [us]", measured)
        if "load" in conditions:
            idle, load = conditions["idle"], conditions["load"]
            ours, bare = (_ratios(load[name], idle[name]) for name in ("compute_us", "bare_us"))
            print(f"load over idle at {rate} Hz: computing {ours}; bare loop {bare}")
    cold = "" if start_up["cold_s"] is None else f", {start_up['cold_s']:.1f} s without caches"
    print(f"first cycle {start_up['cached_s']:.2f} s after the start{cold}")
    for name in real_time["missing"]:
        package = {"cyclictest": "rt-tests"}.get(name, name)
        print(f"{name} is not installed (Debian: apt install {package}): nothing to compare with")
    for text in real_time["refused"]:
        print(f"without {text}")
    if not options.measures:
        return
    with progress_bar("without each measure") as progress:
        figures["measures"] = measure_measures(options.measures, progress)
    table = Table("1 kHz, left out", "condition", "woken late p50 [us]", "p99", "p99.9", "max", "missed", "minor faults")
    for case, by_condition in figures["measures"].items():
        for condition, measured in by_condition.items():
            late = (f"{measured['wake_us'][key]:.1f}" for key in QUANTILES.values())
            table.add(case, condition, *late, f"{measured['missed']}", f"{measured['minor_faults']:g}")
    table.print()


def _print_condition(title: str, measured: dict[str, Any]) -> None:
    rows = {
        "computing": "compute_us",
        "bare loop computing": "bare_us",
        "wake-up to command": "latency_us",
        "woken late": "wake_us",
        "cyclictest": "cyclictest_us",
    }
    table = Table(title, *QUANTILES, "cycles")
    for label, name in rows.items():
        if measured[name]:
            table.add(label, *(f"{measured[name][key]:.1f}" for key in QUANTILES.values()), f"{measured[name]['n']}")
    table.print()
    used, text = measured["usage"], ""
    if measured["cyclictest_us"]:
        text = f"; woken late over cyclictest: {_ratios(measured['wake_us'], measured['cyclictest_us'])}"
    print(
        f"periods missed by own work {measured['missed_own']}, by the host {measured['missed_host']}; "
        f"overran its period {measured['overran']['ours']} times, the bare loop {measured['overran']['bare']}; "
        f"page faults {used['major_faults']:g} major, {used['minor_faults']:g} minor; involuntary switches "
        f"{used['involuntary_switches']:g}; growth {used['resident']:g} bytes{text}"
    )
    over = ", ".join(measured["over_budget"])
    print(f"over budget: {over}" if over else "within the timing budget (hil/loop/budget.toml)")


def _ratios(durations: dict[str, float], others: dict[str, float]) -> str:
    p50, p999 = (durations[key] / others[key] for key in ("p50", "p999"))
    return f"p50 {p50:.2f}, p99.9 {p999:.2f}"


def _panel(options: Namespace, figures: dict[str, Any]) -> None:
    from hil.benchmarks.panel import LIMITS, measure_panel

    with progress_bar("the panel") as progress:
        measured = figures["panel"] = measure_panel(options.panel, progress)
    without, attached = measured["without"], measured["with"]
    table = Table("1 kHz", "without a panel", "with one", "ratio", "noise", "limit")
    for label, name in (("computing", "compute"), ("woken late", "wake")):
        for which, key in (("p50", "p50"), ("p99.9", "p999")):
            cells = [f"{each[f'{name}_us'][key]:.2f}" for each in (without, attached)]
            ratio, noise = (measured[kind][name][key] for kind in ("ratios", "noise"))
            table.add(f"{label} {which} [us]", *cells, f"{ratio:.3f}", f"{noise:.3f}", f"{LIMITS[key]:.2f}")
    table.add("missed by own work", f"{without['missed_own']}", f"{attached['missed_own']}", "", "", f"{LIMITS['missed_own']}")
    cycles = (f"{len(each['overran'])} ({each['stalled']:.1f})" for each in (without, attached))
    table.add("in so many cycles (by stalls)", *cycles, "", "", "")
    table.add("missed by the host", f"{without['missed_host']}", f"{attached['missed_host']}", "", "", "")
    table.add("panel [processors]", "", f"{attached['panel_cores']:.3f}", "", "", f"{LIMITS['panel_cores']:.2f}")
    table.add("channel [processors]", f"{without['channel_cores']:.3f}", f"{attached['channel_cores']:.3f}", "", "", "")
    table.add("stolen [processors]", *(f"{each['stolen_cores']:.4f}" for each in (without, attached)), "", "", "")
    table.add("new pictures [Hz]", "", f"{attached['frames_hz']:.1f}", "", "", f">= {LIMITS['frames_hz']:g}")
    table.print()
    print(
        f"{measured['rounds']} runs, {measured['seconds']:g} s without and with; the page receives "
        f"{attached['bytes_per_s'] / 1e3:.0f} kB/s; ratio: median over the runs; noise: such medians of the time without are "
        "within this factor of 1; by stalls: as many the host explains at most, as some of its stalls hit the thread at work; "
        "stolen: kept from running by a hypervisor that tells"
    )
    for text in measured["refused"]:
        print(f"without {text}")


def _loop(options: Namespace, figures: dict[str, Any]) -> None:
    from hil.benchmarks.loop import measure_speed

    with progress_bar("the loop") as progress:
        figures |= measure_speed(options.target, options.duration, progress)
    table = Table("stage", "p50 [us]", "p99 [us]", "p99.9 [us]")
    for label, percentiles in (*figures["stages_us"].items(), ("whole cycle", figures["cycle_us"])):
        table.add(label, *(f"{percentiles[key]:.2f}" for key in ("p50", "p99", "p999")))
    table.print()
    factor = figures["real_time_factor"]
    print(
        f"{factor['median']:.1f} times real time ({factor['least']:.1f} to {factor['greatest']:.1f}); "
        f"with filterpy {figures['filterpy_real_time_factor']:.2f}, {figures['filterpy_slowdown']:.0f} times slower"
    )


def _plant(options: Namespace, figures: dict[str, Any]) -> None:
    from hil.benchmarks.plant import measure_plant

    with progress_bar("the plant") as progress:
        measured = figures["plant"] = measure_plant(min(options.duration, 10.0), progress)
    table = Table("plant, 1 ms from compiled code", "p50 [us]", "p99 [us]")
    rows = {**measured["calls_us"], "step, FMI 2.0": measured["step_us"]["FMI 2"]}
    for label, percentiles in rows.items():
        table.add(label, f"{percentiles['p50']:.3f}", f"{percentiles['p99']:.3f}")
    table.print()
    print(
        f"all of them {measured['cycle_us']:.2f} us, through FMPy's methods {measured['fmpy_us']:.1f} us, "
        f"{measured['fmpy_slowdown']:.1f} times longer; off by {1e9 * measured['error_m']:.1f} nm at most from substeps "
        f"16 times shorter than {1e3 * measured['substep']:g} ms, in {measured['duration']:g} s of motion"
    )


def _table_of_methods(title: str, figures: dict[str, Any]) -> Table:
    """Figures of each closed form and its refinement: the median over the classes of a group."""
    from statistics import median

    groups: dict[str, list[dict[str, Any]]] = {}
    for label, methods in figures.items():
        groups.setdefault(label.rpartition(".")[0] or label, []).append(methods)
    names = list(dict.fromkeys(name for methods in groups.values() for name in methods[0]))
    table = Table(title, *names)
    for group, members in groups.items():
        cells = []
        for name in names:
            found = [methods[name] for methods in members if name in methods]
            medians = (median(each[kind] for each in found) for kind in ("closed_form", "refined") if found)
            cells.append(" / ".join(f"{figure:.{2 if figure < 10.0 else 1}f}" for figure in medians) or "-")
        table.add(group, *cells)
    return table


def _kinematics(_: Namespace, figures: dict[str, Any]) -> None:
    from hil.benchmarks.kinematics import measure_kinematics

    with progress_bar("direct kinematics") as progress:
        measured = figures["kinematics"] = measure_kinematics(progress)
    newton, in_c = measured["newton"], measured["newton_in_c"]
    times = {**measured["solve_us"], "hexapod": measured["hexapod_us"], "over Newton": newton["ratios"]}
    _table_of_methods("us", times).print()
    _table_of_methods("over C", in_c["ratios"]).print()
    print("closed form / refined")
    rates = ", ".join(f"{name} {rate / 1e3:.0f}" for name, rate in measured["batch_per_s"].items())
    print(f"refined poses per second on all cores [thousands]: {rates}; one call from Python {measured['call_us']:.0f} us")
    print(
        f"Newton's method from lengths, warm: {newton['warm_us']:.2f} us per pose; in C (over C) as LinuxCNC's genhexkins, "
        f"to 1e-9 m: {in_c['warm_us']:.2f} us, {in_c['steps']:.1f} steps"
    )
    table = Table("cold starts [%]", "found by Newton", "mistaken", "found from directions", "mistaken")
    for preset, ranges in measured["cold_starts"].items():
        for where, rates in ranges.items():
            shares = [rates[kind][key] for kind in ("newton", "directions") for key in ("success", "wrong")]
            table.add(f"{preset}, {where}", *(f"{100.0 * share:.1f}" for share in shares))
    table.print()


def _workspace(_: Namespace, figures: dict[str, Any]) -> None:
    from hil.benchmarks.workspace import measure_workspace

    with progress_bar("the workspace"):
        measured = figures["workspace"] = measure_workspace()
    table = Table("workspace, one core", "us per pose", "over inverse kinematics")
    table.add("inverse kinematics with Jacobian", f"{measured['inverse_us']:.3f}", "1.0")
    for name, us in measured["margins_us"].items():
        table.add(f"margins {name}", f"{us:.2f}", f"{measured['ratios'][name]:.1f}")
    table.print()
    print(f"one travel along a random direction, with all limits: {measured['travel_us']:.0f} us")
