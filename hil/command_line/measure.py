"""The command bench."""

import argparse
from pathlib import Path
from typing import Any

from hil.command_line.outputs import add_json, check_outputs, write_json
from hil.command_line.terminal import QUANTILES, progress_bar
from hil.table import Table
from plant.errors import InputError


def add_bench(command: argparse.ArgumentParser) -> None:
    """Measure the loop, the plant and the kinematics: their speed and lateness.

    The loop on the clock: how late it wakes, beside cyclictest, and how long it computes, idle, under load and with a busy
    supervisor; its speed against real time and the microseconds of each stage; the plant's FMU, from compiled code and through
    FMPy, and how exact it is; and direct kinematics: microseconds per pose, against Newton's method from lengths, and whether
    both find the pose from cold.
    """
    command.add_argument(
        "--duration", type=float, default=60.0, help="duration of the simulated motion [s] (default: %(default)g)"
    )
    command.add_argument("--target", default="sines", help="motion or CSV file (default: %(default)s)")
    command.add_argument("--only", choices=("loop", "plant", "kinematics", "clock"), help="one section instead of all")
    command.add_argument(
        "--clock", type=float, default=10.0, metavar="SECONDS",
        help="time on the clock at 1 kHz, idle and again under load; 4 kHz gets a third [s] (default: %(default)g)",
    )  # fmt: skip
    command.add_argument(
        "--measures", type=float, metavar="SECONDS", help="also try the loop without each measure for real time, for this time"
    )
    command.add_argument("--cold", action="store_true", help="measure the start without caches, too (a minute)")
    command.add_argument("--check", action="store_true", help="fail if the loop on the clock is off by more than any noise")
    command.add_argument("--report", type=Path, metavar="FILE.html", help="write histograms of the loop on the clock")
    command.add_argument(
        "--history", type=Path, nargs="+", default=[], metavar="FILE.json", help="earlier figures for the report"
    )
    add_json(command)
    command.set_defaults(run=_bench)


def _bench(options: argparse.Namespace) -> int:
    from hil.benchmarks.clock import GrossExcessError, gross_excess, measure_measures, measure_real_time, measure_start_up
    from hil.benchmarks.kinematics import measure_kinematics
    from hil.benchmarks.loop import machine, measure_speed, read_earlier
    from hil.benchmarks.plant import measure_plant

    check_outputs(options.json, report=options.report)
    for name, seconds in (("--clock", options.clock), ("--measures", options.measures)):
        if seconds is not None and not 0.0 < seconds < float("inf"):
            raise InputError(f"{name} is {seconds:g} s; it must be positive and finite")
    earlier = [read_earlier(path) for path in options.history]
    figures: dict[str, Any] = machine()
    if options.only in (None, "clock"):
        with progress_bar("the loop on the clock") as progress:
            figures["start_up"] = measure_start_up(options.cold)
            figures["real_time"] = measure_real_time({1000.0: options.clock, 4000.0: options.clock / 3.0}, progress)
        _print_real_time(figures["real_time"], figures["start_up"])
        if options.measures:
            with progress_bar("without each measure") as progress:
                figures["measures"] = measure_measures(options.measures, progress)
            _print_measures(figures["measures"])
    if options.only in (None, "loop"):
        with progress_bar("the loop") as progress:
            figures |= measure_speed(options.target, options.duration, progress)
        _print_speed(figures)
    if options.only in (None, "plant"):
        with progress_bar("the plant") as progress:
            figures["plant"] = measure_plant(min(options.duration, 10.0), progress)
        _print_plant(figures["plant"])
    if options.only in (None, "kinematics"):
        with progress_bar("direct kinematics") as progress:
            figures["kinematics"] = measure_kinematics(progress)
        _print_kinematics(figures["kinematics"])
    write_json(options.json, figures)
    if options.report:
        from hil.reports.benchmark import write_report

        write_report(figures, earlier, options.report)
    print(f"{figures['machine']}, {figures['date']}, gough {figures['version']}")
    if options.check and (excess := gross_excess(figures.get("real_time", {"rates": {}}))):
        raise GrossExcessError(f"in gross excess: {'; '.join(excess)}")
    return 0


def _print_real_time(figures: dict[str, Any], start_up: dict[str, Any]) -> None:
    rows = {
        "computing": "compute_us",
        "bare loop computing": "bare_us",
        "wake-up to command": "latency_us",
        "woken late": "wake_us",
        "cyclictest": "cyclictest_us",
    }
    for rate, conditions in figures["rates"].items():
        for condition, measured in conditions.items():
            table = Table(f"{rate} Hz, {condition.replace('_', ' ')} [us]", *QUANTILES, "cycles")
            for label, name in rows.items():
                if measured[name]:
                    cells = [f"{measured[name][key]:.1f}" for key in QUANTILES.values()]
                    table.add(label, *cells, f"{measured[name]['n']}")
            table.print()
            used, text = measured["usage"], ""
            if measured["cyclictest_us"]:
                ratios = [measured["wake_us"][key] / measured["cyclictest_us"][key] for key in ("p50", "p999")]
                text = f"; woken late over cyclictest: p50 {ratios[0]:.2f}, p99.9 {ratios[1]:.2f}"
            print(
                f"periods missed by own work {measured['missed_own']}, by the host {measured['missed_host']}; page faults "
                f"{used['major_faults']:g} major, {used['minor_faults']:g} minor; involuntary switches "
                f"{used['involuntary_switches']:g}; growth {used['resident']:g} bytes{text}"
            )
            over = ", ".join(measured["over_budget"])
            print(f"over budget: {over}" if over else "within the timing budget (hil/loop/budget.toml)")
        if "load" in conditions:
            idle, load = conditions["idle"], conditions["load"]
            ours, bare = ([load[name][key] / idle[name][key] for key in ("p50", "p999")] for name in ("compute_us", "bare_us"))
            print(
                f"load over idle at {rate} Hz: computing p50 {ours[0]:.2f}, p99.9 {ours[1]:.2f}; bare loop p50 {bare[0]:.2f}, "
                f"p99.9 {bare[1]:.2f}"
            )
    cold = "" if start_up["cold_s"] is None else f", {start_up['cold_s']:.1f} s without caches"
    print(f"first cycle {start_up['cached_s']:.2f} s after the start{cold}")
    for name in figures["missing"]:
        package = {"cyclictest": "rt-tests"}.get(name, name)
        print(f"{name} is not installed (Debian: apt install {package}): nothing to compare with")
    for text in figures["refused"]:
        print(f"without {text}")


def _print_measures(figures: dict[str, Any]) -> None:
    table = Table("1 kHz, left out", "condition", "woken late p50 [us]", "p99", "p99.9", "max", "missed", "minor faults")
    for case, conditions in figures.items():
        for condition, measured in conditions.items():
            late = [f"{measured['wake_us'][key]:.1f}" for key in QUANTILES.values()]
            table.add(case, condition, *late, f"{measured['missed']}", f"{measured['minor_faults']:g}")
    table.print()


def _print_speed(figures: dict[str, Any]) -> None:
    table = Table("stage", "p50 [us]", "p99 [us]", "p99.9 [us]")
    for label, percentiles in (*figures["stages_us"].items(), ("whole cycle", figures["cycle_us"])):
        table.add(label, *(f"{percentiles[key]:.2f}" for key in ("p50", "p99", "p999")))
    table.print()
    factor = figures["real_time_factor"]
    print(
        f"{factor['median']:.1f} times real time ({factor['least']:.1f} to {factor['greatest']:.1f}); "
        f"with filterpy {figures['filterpy_real_time_factor']:.2f}, {figures['filterpy_slowdown']:.0f} times slower"
    )


def _print_plant(figures: dict[str, Any]) -> None:
    table = Table("plant, 1 ms from compiled code", "p50 [us]", "p99 [us]")
    rows = {**figures["calls_us"], "step, FMI 2.0": figures["step_us"]["FMI 2"]}
    for label, percentiles in rows.items():
        table.add(label, f"{percentiles['p50']:.3f}", f"{percentiles['p99']:.3f}")
    table.print()
    print(
        f"all of them {figures['cycle_us']:.2f} us, through FMPy's methods {figures['fmpy_us']:.1f} us, "
        f"{figures['fmpy_slowdown']:.1f} times longer; off by {1e9 * figures['error_m']:.1f} nm at most from substeps 16 times "
        f"shorter than {1e3 * figures['substep']:g} ms, in {figures['duration']:g} s of motion"
    )


def _print_kinematics(figures: dict[str, Any]) -> None:
    from statistics import median

    groups: dict[str, list[dict[str, Any]]] = {}
    for label, methods in figures["solve_us"].items():
        groups.setdefault(label.rpartition(".")[0], []).append(methods)
    groups["hexapod"] = [figures["hexapod_us"]]
    names = list(dict.fromkeys(name for methods in groups.values() for name in methods[0]))
    table = Table("us, closed / refined", *names)
    for group, measured in groups.items():
        cells = []
        for name in names:
            found = [methods[name] for methods in measured if name in methods]
            medians = (f"{median(each[kind] for each in found):.2f}" for kind in ("closed_form", "refined"))
            cells.append(" / ".join(medians) if found else "-")
        table.add(group, *cells)
    newton = figures["newton"]
    times = {name: f"{ratio['closed_form']:.1f} / {ratio['refined']:.1f}" for name, ratio in newton["ratios"].items()}
    table.add("hexapod, over Newton", *(times.get(name, "-") for name in names))
    table.print()
    rates = ", ".join(f"{name} {rate / 1e3:.0f}" for name, rate in figures["batch_per_s"].items())
    print(f"refined poses per second on all cores [thousands]: {rates}; one call from Python {figures['call_us']:.0f} us")
    print(f"Newton's method from lengths, warm: {newton['warm_us']:.2f} us per pose")
    table = Table("cold starts [%]", "found by Newton", "mistaken", "found from directions", "mistaken")
    for preset, ranges in figures["cold_starts"].items():
        for where, rates in ranges.items():
            shares = [rates[kind][key] for kind in ("newton", "directions") for key in ("success", "wrong")]
            table.add(f"{preset}, {where}", *(f"{100.0 * share:.1f}" for share in shares))
    table.print()
