"""Frames against 4x4 matrices and scipy's rotations, which share no line with them; and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from controller.frames import (
    BASE,
    LEVEL,
    PLATFORM,
    Frame,
    Frames,
    Move,
    Pivot,
    base_from_level,
    base_twist_from_level,
    compose,
    inverse,
    level_from_base,
    level_twist_from_base,
    load_frames,
    parse_frames,
    save_frames,
)
from controller.frames.tree import FARTHEST_M, MOST_FRAMES
from plant.errors import InputError, UnknownNameError
from plant.pose import Pose, pose_errors, rotation_from_vector

ROUNDING = 1e-12

seeds = st.integers(0, 2**32 - 1)


def random_pose(random, count=None):
    shape = () if count is None else (count,)
    rotation = Rotation.random(count, random_state=np.random.RandomState(random.integers(2**31))).as_matrix()
    return Pose(random.uniform(-1.0, 1.0, (*shape, 3)), rotation)


def matrix(pose):
    whole = np.zeros((*pose.position.shape[:-1], 4, 4))
    whole[..., :3, :3], whole[..., :3, 3], whole[..., 3, 3] = pose.rotation, pose.position, 1.0
    return whole


def same(first, second):
    return np.abs(matrix(first) - matrix(second)).max() < ROUNDING


def random_frames(random, work_root=BASE):
    """Work frames and tools linked in chains, in any order in the file, with a pivot somewhere."""
    frames = {}
    for kind, root in (("w", work_root), ("t", PLATFORM)):
        names = [f"{kind}{k}" for k in range(random.integers(1, 6))]
        for k, name in enumerate(names):
            pose = random_pose(random)
            parent = str(random.choice([root, *names[:k]]))
            frames[name] = Frame(parent, pose.position, pose.rotation)
    names = list(frames)
    random.shuffle(names)
    work, tool = (str(random.choice([name for name in names if name[0] == kind])) for kind in "wt")
    pivot = Pivot(str(random.choice([work_root, PLATFORM, *names])), random.uniform(-1.0, 1.0, 3))
    return Frames({name: frames[name] for name in names}, work, tool, pivot if random.random() < 0.7 else None)


def chained(frames, name):
    """The matrix of a frame in its root."""
    whole = np.eye(4)
    while name in frames.frames:
        whole = matrix(frames.frames[name].pose) @ whole
        name = frames.frames[name].parent
    return whole


@given(seeds)
def test_linked_frames_are_products_of_matrices(seed):
    random = np.random.default_rng(seed)
    frames, platform, attitude = random_frames(random), random_pose(random), random_pose(random).rotation
    roots = {BASE: np.eye(4), PLATFORM: matrix(platform), LEVEL: matrix(Pose(np.zeros(3), attitude.T))}
    in_base = {name: roots[frames.root(name)] @ chained(frames, name) for name in frames}
    for one, other in random.choice(list(frames), (5, 2)):
        found = frames.pose(str(one), str(other), platform, attitude)
        np.testing.assert_allclose(matrix(found), np.linalg.inv(in_base[other]) @ in_base[one], atol=ROUNDING)


@given(seeds, st.sampled_from([BASE, LEVEL]))
def test_poses_go_through_any_pair_and_back(seed, root):
    """On a base that is not level, a different one for each pose."""
    random = np.random.default_rng(seed)
    active = random_frames(random, root).active()
    in_base, attitudes = random_pose(random, 20), random_pose(random, 20).rotation
    platform = level_from_base(in_base, attitudes) if root == LEVEL else in_base
    tool = active.read(platform)
    wanted = np.linalg.inv(chained(active.frames, active.frames.work)) @ matrix(platform)
    np.testing.assert_allclose(matrix(tool), wanted @ chained(active.frames, active.frames.tool), atol=ROUNDING)
    back = active.platform(tool)
    assert same(back, platform)
    assert same(base_from_level(back, attitudes) if root == LEVEL else back, in_base)


@given(seeds)
def test_targets_mean_the_same_poses_back_and_forth(seed):
    random = np.random.default_rng(seed)
    frames, home, platform = random_frames(random), random_pose(random), random_pose(random, 10)
    for active in (frames.active(), frames.active(BASE), frames.active(BASE, PLATFORM)):
        assert same(active.from_target(home, *active.to_target(home, platform)), platform)
        assert same(active.displaced(home, *active.displacement(home, platform)), platform)


@given(seeds)
def test_displacements_from_home_are_what_they_are_without_frames(seed):
    """Of {2} in {1}: the position is added, and the turn comes after that of home."""
    random = np.random.default_rng(seed)
    home, by = random_pose(random), random_pose(random, 5)
    platform = Frames().active().from_target(home, by.position, by.rotation)
    assert same(platform, Pose(home.position + by.position, by.rotation @ home.rotation))


@given(seeds, st.sampled_from([BASE, LEVEL]))
def test_twists_are_those_of_small_motions(seed, root):
    """Against the central difference of poses, in the axes of the work frame."""
    random = np.random.default_rng(seed)
    active, platform = random_frames(random, root).active(), random_pose(random)
    twist, t = random.uniform(-1.0, 1.0, 6), 1e-6

    def at(time):
        moved = Rotation.from_rotvec(time * twist[3:]).as_matrix() @ platform.rotation
        return active.read(Pose(platform.position + time * twist[:3], moved))

    before, after = at(-t), at(t)
    turn = Rotation.from_matrix(after.rotation @ before.rotation.T).as_rotvec()
    difference = np.concatenate([after.position - before.position, turn]) / (2.0 * t)
    found = active.read_twist(platform, twist)
    np.testing.assert_allclose(found, difference, atol=1e-8)
    np.testing.assert_allclose(active.platform_twist(platform, found), twist, atol=ROUNDING)


@given(seeds)
def test_a_level_frame_takes_the_motion_of_the_base_off(seed):
    """Against the central difference of poses on a base that turns."""
    random = np.random.default_rng(seed)
    pose, attitude = random_pose(random), random_pose(random).rotation
    twist, rate, t = random.uniform(-1.0, 1.0, 6), random.uniform(-1.0, 1.0, 3), 1e-6

    def at(time):
        # The rate is seen in {1}.
        turned = attitude @ Rotation.from_rotvec(time * rate).as_matrix()
        moved = Rotation.from_rotvec(time * twist[3:]).as_matrix() @ pose.rotation
        return level_from_base(Pose(pose.position + time * twist[:3], moved), turned)

    before, after = at(-t), at(t)
    turn = Rotation.from_matrix(after.rotation @ before.rotation.T).as_rotvec()
    difference = np.concatenate([after.position - before.position, turn]) / (2.0 * t)
    found = level_twist_from_base(pose, twist, attitude, rate)
    np.testing.assert_allclose(found, difference, atol=1e-8)
    np.testing.assert_allclose(base_twist_from_level(pose, found, attitude, rate), twist, atol=ROUNDING)


@given(seeds)
def test_covariances_go_through_and_back(seed):
    random = np.random.default_rng(seed)
    active, platforms = random_frames(random).active(), random_pose(random, 4)
    root = random.normal(size=(4, 6, 6))
    covariance = root @ np.swapaxes(root, 1, 2)
    read = active.read_covariance(platforms, covariance)
    np.testing.assert_allclose(active.platform_covariance(platforms, read), covariance, atol=1e-11)
    # The axes of a pure turn of the frames do not change how uncertain a pose is in all.
    np.testing.assert_allclose(np.trace(read[:, 3:, 3:], axis1=1, axis2=2), np.trace(covariance[:, 3:, 3:], axis1=1, axis2=2))


def test_a_covariance_is_that_of_many_drawn_poses():
    random = np.random.default_rng(5)
    active, platform = random_frames(random).active(), random_pose(random)
    root = 1e-4 * random.normal(size=(6, 6))
    errors = random.normal(size=(20_000, 6)) @ root.T
    turned = np.array([rotation_from_vector(error) @ platform.rotation for error in errors[:, 3:]])
    drawn, true = active.read(Pose(platform.position + errors[:, :3], turned)), active.read(platform)
    found = np.cov(pose_errors(drawn.position, drawn.rotation, true.position, true.rotation).T)
    expected = active.read_covariance(platform, root @ root.T)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((found - expected) / scale).max() < 0.04


@given(seeds)
def test_a_move_shifts_the_pivot_and_turns_about_it(seed):
    random = np.random.default_rng(seed)
    active, platform = random_frames(random).active(), random_pose(random)
    axes = str(random.choice([each for each in active.frames if each != LEVEL]))
    translation, vector = random.uniform(-0.5, 0.5, 3), random.uniform(-1.0, 1.0, 3)
    moved = active.moved(platform, Move(translation, vector, axes))
    in_base = active.axes(platform, axes)
    turn = Rotation.from_rotvec(in_base @ vector).as_matrix()
    pivot = active.pivot(platform)
    np.testing.assert_allclose(moved.rotation, turn @ platform.rotation, atol=ROUNDING)
    # A point of the platform that was at the pivot is shifted, whatever the turn is.
    carried = compose(moved, compose(inverse(platform), Pose(pivot, np.eye(3)))).position
    np.testing.assert_allclose(carried, pivot + in_base @ translation, atol=ROUNDING)
    again = active.move_between(platform, moved, axes)
    np.testing.assert_allclose(again.translation, translation, atol=ROUNDING)
    np.testing.assert_allclose(again.rotation_vector, vector, atol=1e-9)
    t = 1e-6
    before, after = (active.moved(platform, Move(translation, vector, axes), share) for share in (-t, t))
    turned = Rotation.from_matrix(after.rotation @ before.rotation.T).as_rotvec()
    rate = np.concatenate([after.position - before.position, turned]) / (2.0 * t)
    np.testing.assert_allclose(active.rate(platform, Move(translation, vector, axes)), rate, atol=1e-8)
    ways = active.moved(platform, Move(translation, vector, axes), np.linspace(0.0, 1.0, 5))
    assert same(Pose(ways.position[0], ways.rotation[0]), platform)
    assert same(Pose(ways.position[-1], ways.rotation[-1]), moved)


def test_a_pivot_on_a_tool_moves_with_it_and_one_on_the_base_stays():
    home = Pose(np.array([0.0, 0.0, 0.3]), np.eye(3))
    turn = Move(rotation_vector=(0.0, 0.0, np.pi / 2.0))
    tip = {"tip": Frame(PLATFORM, np.array([0.1, 0.0, 0.0]))}
    tool = Frames(tip, tool="tip").active()
    fixed = Frames(tip, tool="tip", pivot=Pivot(BASE, np.array([0.1, 0.0, 0.3]))).active()
    for active in (tool, fixed):
        np.testing.assert_allclose(active.moved(home, turn).position, [0.1, -0.1, 0.3], atol=ROUNDING)
    shifted = Pose(home.position + [0.05, 0.0, 0.0], home.rotation)
    np.testing.assert_allclose(tool.moved(shifted, turn).position, [0.15, -0.1, 0.3], atol=ROUNDING)
    np.testing.assert_allclose(fixed.moved(shifted, turn).position, [0.1, -0.05, 0.3], atol=ROUNDING)


@given(seeds)
def test_measured_in_place_the_tool_reads_zero(seed):
    random = np.random.default_rng(seed)
    frames, platform = random_frames(random), random_pose(random)
    here = frames.zeroed("new", platform, parent=BASE).enabled("new").active().read(platform)
    assert same(here, Pose(np.zeros(3), np.eye(3)))
    touched = frames.zeroed("tip", platform, parent=PLATFORM).enabled(tool="tip").active().read(platform)
    assert same(touched, Pose(np.zeros(3), np.eye(3)))
    # On a base that is not level, in a frame that is.
    attitude = random_pose(random).rotation
    level = frames.zeroed("new", platform, attitude, LEVEL).enabled("new")
    assert same(replace(level, pivot=None).active().read(level_from_base(platform, attitude)), Pose(np.zeros(3), np.eye(3)))


def test_measured_in_place_a_frame_can_keep_its_axes():
    random = np.random.default_rng(1)
    frames, platform = Frames({"table": Frame(BASE, rotation=random_pose(random).rotation)}, "table"), random_pose(random)
    zeroed = frames.zeroed("table", platform, turn=False)
    np.testing.assert_array_equal(zeroed.frames["table"].rotation, frames.frames["table"].rotation)
    np.testing.assert_allclose(zeroed.active().read(platform).position, np.zeros(3), atol=ROUNDING)


@given(seeds)
def test_a_frame_that_is_linked_in_place_stays_there(seed):
    random = np.random.default_rng(seed)
    frames = random_frames(random)
    name = str(random.choice(list(frames.frames)))
    others = [each for each in frames if frames.root(each) == frames.root(name) and name not in frames.chain(each)]
    linked = frames.linked(name, str(random.choice(others)), keep_place=True)
    assert all(same(linked.place(each), frames.place(each)) for each in frames)
    assert linked.frames[name].parent in others


@given(seeds)
def test_a_file_holds_frames_to_the_last_bit(seed):
    frames = random_frames(np.random.default_rng(seed))
    read = parse_frames(frames.text(), "cell.toml")
    assert (read.work, read.tool, list(read.frames)) == (frames.work, frames.tool, list(frames.frames))
    for name, frame in frames.frames.items():
        np.testing.assert_array_equal(read.frames[name].position, frame.position)
        np.testing.assert_allclose(read.frames[name].rotation, frame.rotation, atol=1e-15)
    assert (read.pivot is None) == (frames.pivot is None)
    assert read.text() == parse_frames(read.text(), "again.toml").text()


CELL = """
work = "table"
tool = "needle"

[pivot]
parent = "needle"
position = [0.0, 0.0, 0.01]

[frames.table]
note = "the fixture's corner"
parent = "base"
position = [0.02, -0.01, 0.3]
angles_deg = [10.0, 20.0, 30.0]

[frames.needle]
parent = "platform"
position = [0.0, 0.0, 0.11]
rotation_vector_deg = [0.0, 0.0, 45.0]

[frames.corner]
parent = "table"
quaternion = [0.0, 1.0, 0.0, 0.0]
"""


def test_orientations_have_three_forms(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(CELL)
    frames = load_frames(path)
    expected = Rotation.from_euler("xyz", [10.0, 20.0, 30.0], degrees=True).as_matrix()
    np.testing.assert_allclose(frames.frames["table"].rotation, expected, atol=ROUNDING)
    expected = Rotation.from_rotvec([0.0, 0.0, 45.0], degrees=True).as_matrix()
    np.testing.assert_allclose(frames.frames["needle"].rotation, expected, atol=ROUNDING)
    np.testing.assert_allclose(frames.frames["corner"].rotation, np.diag([1.0, -1.0, -1.0]), atol=ROUNDING)
    assert list(frames) == ["base", "table", "corner", "level", "platform", "needle"]
    assert frames.dependents("base") == ["table", "corner"]
    save_frames(path, frames)
    # What is not changed stays as its writer gave it.
    assert "angles_deg = [10.0, 20.0, 30.0]" in path.read_text() and "the fixture's corner" in path.read_text()
    assert load_frames(path).text() == frames.text()


def changed(old, new):
    assert old in CELL
    return CELL.replace(old, new)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            changed('parent = "base"', 'parent = "corner"'),
            "in a circle: table on corner on table; let one of them stand on base",
        ),
        (changed('parent = "table"', 'parent = "tabel"'), "'corner' stands on 'tabel', which does not exist; .* mean 'table'"),
        (changed('work = "table"', 'work = "needle"'), "'needle' stands on the platform, so it is a tool"),
        (changed('tool = "needle"', 'tool = "table"'), "'table' stands on base, so it is a work frame, not a tool"),
        (changed('work = "table"', 'work = "desk"'), "no frame 'desk'; there are base, level, platform, table"),
        (
            changed("0.11", "110.0"),
            r"\[frames.needle\]: position is 110 m off along an axis; at most 10 m will do: give metres",
        ),
        (changed("0.11", "nan"), r"position\[2\] is nan; it must be finite"),
        (changed("[0.0, 1.0, 0.0, 0.0]", "[0.0, 1.0, 1.0, 0.0]"), "quaternion has length 1.41421; .* normalise it"),
        (
            changed('note = "the', 'rotation_vector_deg = [1, 2, 3]\nnote = "the'),
            "has angles_deg and rotation_vector_deg: keep one",
        ),
        (changed("angles_deg", "angle_deg"), r"\[frames.table\] has no entry 'angle_deg'; .* did you mean 'angles_deg'"),
        (changed('parent = "platform"\n', ""), r"\[frames.needle\] lacks parent"),
        (changed('parent = "platform"', "parent = 3"), "parent is 3; it must be a text in quotes"),
        (changed("[frames.corner]", "[frames.base]"), "'base' is always there and cannot be changed: choose another name"),
        (changed("[frames.corner]", '[frames."a b"]'), "'a b' cannot name a frame: use a letter"),
        (changed('parent = "needle"', 'parent = "tip"'), "the pivot stands on 'tip', which does not exist"),
        (changed("[pivot]", "[pivots]"), "the file has no entry 'pivots'"),
        (changed('work = "table"', "work = 1"), "work is 1; it must be a text in quotes"),
        ("frames = 1", "frames is 1; it must be a table"),
        ("[frames]\ntable = 1", r"frames.table is 1; it must be a table"),
        ("[pivot]\nparent = 1", r"\[pivot\]: parent is 1"),
        ("work =", "is not valid TOML"),
        ("".join(f'[frames.f{k}]\nparent = "base"\n' for k in range(MOST_FRAMES + 1)), "there are 201 frames; at most 200"),
    ],
)
def test_a_file_that_makes_no_sense_is_refused_with_the_reason(text, message):
    with pytest.raises((InputError, UnknownNameError), match=f"cell.toml.*{message}"):
        parse_frames(text, "cell.toml")


def test_what_depends_on_a_frame_keeps_it():
    frames = parse_frames(CELL, "cell.toml")
    with pytest.raises(InputError, match="'table' cannot be removed: corner stands on it, it is enabled; change that first"):
        frames.removed("table")
    with pytest.raises(InputError, match="'needle' cannot be removed: the pivot stands on it, it is enabled"):
        frames.removed("needle")
    assert "corner" not in frames.removed("corner").frames
    with pytest.raises(UnknownNameError, match=r"no frame 'korner'.*did you mean 'corner'"):
        frames.removed("korner")
    with pytest.raises(InputError, match="'base' is always there"):
        frames.removed("base")


def test_links_that_make_no_sense_are_refused():
    frames = parse_frames(CELL, "cell.toml")
    with pytest.raises(InputError, match="'table' cannot stand on 'corner', which stands on 'table'"):
        frames.linked("table", "corner")
    with pytest.raises(InputError, match="'table' cannot stand on 'table', which is itself"):
        frames.linked("table", "table")
    with pytest.raises(InputError, match=r"'corner' stands on base and 'platform' on platform, .* no place to keep"):
        frames.linked("corner", "platform", keep_place=True)
    with pytest.raises(InputError, match="'needle' stands on base, so it is a work frame"):
        frames.linked("needle", "base")
    assert frames.linked("corner", "needle").root("corner") == PLATFORM
    assert frames.linked("corner", "base").frames["corner"].entries["parent"] == "base"


def test_measuring_in_place_needs_a_parent_and_what_lies_between():
    frames, here = parse_frames(CELL, "cell.toml"), Pose(np.zeros(3), np.eye(3))
    with pytest.raises(InputError, match="'needle' stands on base, so it is a work frame, not a tool"):
        frames.zeroed("needle", here, parent="base")
    with pytest.raises(UnknownNameError, match="no frame 'new'"):
        frames.zeroed("new", here)
    with pytest.raises(InputError, match="between the level frame and the others lies the attitude of the base: give it"):
        frames.zeroed("new", here, parent=LEVEL)
    with pytest.raises(InputError, match="at most 10 m"):
        frames.zeroed("new", Pose(np.array([2.0 * FARTHEST_M, 0.0, 0.0]), np.eye(3)), parent=BASE)


def test_what_moves_against_the_work_frame_carries_neither_pivot_nor_axes():
    swaying = Frames({"deck": Frame(LEVEL)}, "deck")
    with pytest.raises(
        InputError, match=r"the pivot stands on base, and the work frame 'deck' on level, .* on level or platform"
    ):
        replace(swaying, pivot=Pivot(BASE)).active()
    with pytest.raises(InputError, match="base stands on base, and the work frame 'deck' on level"):
        swaying.active().axes(Pose(np.zeros(3), np.eye(3)), BASE)
    with pytest.raises(InputError, match="between a tool and a work frame lies the platform: give its pose"):
        Frames().pose(BASE, PLATFORM)
    with pytest.raises(InputError, match=r"translation\[0\] is nan"):
        Frames().active().moved(Pose(np.zeros(3), np.eye(3)), Move((np.nan, 0.0, 0.0)))
