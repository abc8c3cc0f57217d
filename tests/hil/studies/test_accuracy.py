"""Accuracy by Monte Carlo: the design's table, consistent covariances for every type, and the documented table of classes."""

from pathlib import Path

import numpy as np
import pytest

from hil.studies import accuracy
from hil.studies.accuracy import class_table, evaluate_accuracy, evaluate_classes
from plant.errors import InputError
from plant.mechanism import load_spatial
from plant.mechanism.classification import planar_classes, spatial_classes

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "classes.md"
TYPES = ["6-3-I", "6-3-II", "6-4-I", "6-4-II", "6-5", "hexapod"]


def errors_of(accuracy):
    return {estimator.label: errors for estimator, errors in accuracy.errors.items()}


def test_the_table_of_the_design_is_reproduced():
    """Design 5.3, RMS in mm and deg."""
    found = errors_of(evaluate_accuracy(load_spatial("hexapod")))
    expected = {
        "paper, section 5: two legs + magnetic yaw": (6.28, 1.48),
        "section 5, six legs + magnetic yaw": (1.31, 1.48),
        "six legs alone": (0.386, 0.195),
        "six legs + vertical": (0.374, 0.083),
        "six legs + vertical, refined": (0.373, 0.078),
    }
    for label, figures in expected.items():
        rms = (1e3 * found[label].position_rms, np.degrees(found[label].rotation_rms))
        np.testing.assert_allclose(rms, figures, rtol=0.1, err_msg=label)


@pytest.mark.parametrize("name", TYPES)
def test_refined_poses_are_consistent_and_at_the_bound(name):
    accuracy = evaluate_accuracy(load_spatial(name), 2000, seed=0)
    least, greatest = accuracy.nees_bounds
    assert least < 6.0 < greatest < 6.25
    for estimator, errors in accuracy.errors.items():
        if estimator.refine:
            assert least < errors.nees < greatest, estimator.label
            assert 0.95 < errors.position_over_bound < 1.05, estimator.label
            assert 0.95 < errors.rotation_over_bound < 1.05, estimator.label
            assert errors.solved == 1.0 or (name, estimator.method) == ("6-3-II", "legs")
        else:
            assert errors.position_over_bound > 0.97, estimator.label


def test_seeds_settle_the_figures():
    mechanism = load_spatial("6-4-I")
    first, again, other = (evaluate_accuracy(mechanism, 50, seed).summary() for seed in (3, 3, 4))
    assert first == again
    assert first["errors"] != other["errors"]
    with pytest.raises(InputError, match="poses"):
        evaluate_accuracy(mechanism, 0)


def test_classes_need_a_mechanism():
    with pytest.raises(InputError, match="there are 0 mechanisms of each class; at least 1 is needed"):
        evaluate_classes(mechanisms=0)


def few_classes():
    """Some rows of `evaluate_classes`, by their numbers."""
    classes = spatial_classes()
    return {k: accuracy._evaluate_class(0, 20, k, classes[k]) for k in (0, 17, 34, 51)}


def all_classes():
    return dict(enumerate(evaluate_classes()))


@pytest.mark.parametrize("evaluate", [few_classes, pytest.param(all_classes, marks=pytest.mark.slow)])
def test_in_every_class_gough_is_more_accurate_and_the_documented_table_is_what_the_command_prints(evaluate):
    classes = evaluate()
    for row in classes.values():
        if not row.label.startswith("planar"):
            assert row.vertical_errors[0] < row.paper_errors[0], row.label
            assert row.vertical_errors[1] < row.paper_errors[1], row.label
            assert row.alone_needs.startswith(("any 4 legs", "4 legs")), row.label

    lines = DOCUMENT.read_text(encoding="utf-8").splitlines()
    documented = [line for line in lines if line.startswith(("| n-", "| planar"))]
    assert len(documented) == len(spatial_classes()) + len(planar_classes()) == 64
    assert len(classes) == 64 or evaluate is few_classes
    printed = class_table(list(classes.values())).markdown().splitlines()
    assert lines[lines.index(documented[0]) - 2 :][:2] == printed[:2]
    for number, row in zip(classes, printed[2:], strict=True):
        for field, value in zip(documented[number].split(" | "), row.split(" | "), strict=True):
            if " mm, " in value:
                np.testing.assert_allclose(figures(field), figures(value), rtol=0.05, atol=0.011)
            else:
                assert field == value


def figures(cell):
    return [float(part.split()[0]) for part in cell.split(",")]
