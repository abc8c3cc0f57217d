"""The benchmark of the plant measures what it says, and the plant is as exact as promised."""

import pytest

from hil.benchmarks.plant import measure_plant


@pytest.mark.slow
def test_the_plant_is_measured_and_exact() -> None:
    """Its speed is for a quiet machine to judge."""
    shares: list[float] = []
    figures = measure_plant(0.5, shares.append)
    assert 0.0 < figures["error_m"] < 1e-7
    parts = [percentiles["p50"] for percentiles in figures["calls_us"].values()]
    assert all(part > 0.0 for part in parts) and max(parts) == figures["calls_us"]["step"]["p50"]
    assert figures["fmpy_slowdown"] == figures["fmpy_us"] / figures["cycle_us"] > 1.0
    assert shares == sorted(shares) and shares[-1] == 1.0
