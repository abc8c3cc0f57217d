"""Mechanisms: what a preset says, what two arrays are enough for, and what is refused."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from plant.dynamics.variables import SPATIAL
from plant.errors import InputError, UnknownNameError, UnreachableError
from plant.mechanism import LEGS, Limits, Mechanism, PlanarMechanism, load_in_space, load_mechanism, load_spatial, six_rows
from plant.mechanism.planar import PlanarPose
from plant.pose import Array, Pose

BASE = [[0.3, -0.05, 0.0], [0.3, 0.05, 0.0], [-0.1, 0.28, 0.0], [-0.2, 0.23, 0.0], [-0.2, -0.23, 0.0], [-0.1, -0.28, 0.0]]
PLATFORM = [
    [0.13, -0.15, 0.0],
    [0.13, 0.15, 0.0],
    [0.06, 0.19, 0.0],
    [-0.19, 0.04, 0.0],
    [-0.19, -0.04, 0.0],
    [0.06, -0.19, 0.0],
]
HOME = Pose(np.array([0.0, 0.0, 0.35]), np.eye(3))

seeds = st.integers(0, 2**32 - 1)


def lengths_at(mechanism: Mechanism, position: Array, rotation: Array) -> Array:
    return np.linalg.norm(position + mechanism.platform_joints @ rotation.T - mechanism.base_joints, axis=1)


def changed(rows: list[list[float]], row: int, value: list[float]) -> list[list[float]]:
    return [value if i == row else old for i, old in enumerate(rows)]


# ---- the preset ----


def test_the_preset_has_the_geometry_of_the_reference(hexapod: Mechanism) -> None:
    def polar(radius: float, degrees: list[float]) -> Array:
        angles = np.radians(degrees)
        return radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(6)])

    np.testing.assert_allclose(hexapod.base_joints, polar(0.30, [-12, 12, 108, 132, 228, 252]), atol=1e-15)
    np.testing.assert_allclose(hexapod.platform_joints, polar(0.20, [312, 48, 72, 168, 192, 288]), atol=1e-15)
    np.testing.assert_array_equal(hexapod.up_in_base, [0.0, 0.0, 1.0])


def test_the_preset_has_the_lengths_and_limits_of_the_reference(hexapod: Mechanism) -> None:
    home, limits = hexapod.require_home(), hexapod.require_limits()
    np.testing.assert_array_equal(home.position, [0.0, 0.0, 0.35])
    np.testing.assert_array_equal(home.rotation, np.eye(3))
    lengths = lengths_at(hexapod, home.position, home.rotation)
    np.testing.assert_allclose(lengths, 0.394, atol=5e-4)
    np.testing.assert_allclose(limits.stroke - lengths[:, None], np.tile([-0.06, 0.06], (6, 1)), atol=1e-15)
    assert (limits.velocity, limits.acceleration, limits.jerk) == (0.25, 3.0, 60.0)


def test_the_preset_reaches_what_the_reference_reaches(hexapod: Mechanism) -> None:
    home, stroke = hexapod.require_home(), hexapod.require_limits().stroke

    def reach(direction: Array, greatest: float) -> float:
        """How far the platform goes along or about an axis until the first leg comes to its end."""

        def room(amount: float) -> float:
            turned = Rotation.from_rotvec(amount * direction[3:]).as_matrix()
            lengths = lengths_at(hexapod, home.position + amount * direction[:3], turned)
            return float(np.minimum(lengths - stroke[:, 0], stroke[:, 1] - lengths).min())

        # No leg leaves its stroke and comes back before.
        found = float(brentq(room, 0.0, greatest))
        assert min(room(found * share) for share in np.linspace(0.0, 0.999, 200)) > 0.0
        return found

    axes = np.eye(6)

    def either_way(axis: Array, greatest: float) -> float:
        return min(reach(axis, greatest), reach(-axis, greatest))

    assert either_way(axes[0], 0.15) == pytest.approx(0.117, abs=1e-3)
    assert either_way(axes[1], 0.15) == pytest.approx(0.108, abs=1e-3)
    assert reach(axes[2], 0.15) == pytest.approx(0.066, abs=1e-3)
    assert reach(-axes[2], 0.15) == pytest.approx(0.069, abs=1e-3)
    tilt = min(either_way(axes[3], 0.6), either_way(axes[4], 0.6))
    np.testing.assert_allclose(np.degrees([tilt, either_way(axes[5], 0.8)]), [19.6, 31.4], atol=0.05)


def test_the_preset_has_every_parameter_of_the_plant(hexapod: Mechanism) -> None:
    parameters = hexapod.plant_parameters()
    assert list(parameters) == [variable.name for variable in SPATIAL.parameters]
    assert {name: value.shape for name, value in parameters.items()} == {v.name: v.shape for v in SPATIAL.parameters}
    stroke = hexapod.require_limits().stroke
    np.testing.assert_allclose(parameters["stop.minimum_length"], stroke[:, 0] - 0.002)
    np.testing.assert_allclose(parameters["stop.maximum_length"], stroke[:, 1] + 0.002)
    assert parameters["payload.mass"] == 10.0
    np.testing.assert_array_equal(parameters["friction.coulomb"], np.full(6, 15.0))


def test_the_plant_starts_at_the_pose_asked_for(hexapod: Mechanism) -> None:
    start = Pose(np.array([0.01, 0.02, 0.36]), Rotation.from_rotvec([0.0, 0.0, 0.2]).as_matrix())
    parameters = hexapod.plant_parameters(start)
    np.testing.assert_array_equal(parameters["initial_position"], start.position)
    np.testing.assert_allclose(parameters["initial_quaternion"], [np.cos(0.1), 0.0, 0.0, np.sin(0.1)], atol=1e-15)


# ---- two arrays ----


def random_legs(seed: int) -> tuple[Array, Array]:
    """Joints anywhere on two discs, not flat, sometimes shared."""
    random = np.random.default_rng(seed)
    angles = np.sort(random.uniform(0.0, 2.0 * np.pi, 6))
    ring = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(6)])
    base = 0.3 * ring + random.normal(0.0, 0.02, (6, 3))
    platform = 0.2 * ring + random.normal(0.0, 0.02, (6, 3))
    if seed % 2:
        platform[[1, 3, 5]] = platform[[0, 2, 4]]
    return base, platform


@given(seeds)
def test_two_arrays_are_enough(seed: int) -> None:
    base, platform = random_legs(seed)
    mechanism = Mechanism.from_legs(base, platform)
    np.testing.assert_array_equal(mechanism.base_joints, base)
    np.testing.assert_array_equal(mechanism.platform_joints, platform)
    assert mechanism.home is None and mechanism.limits is None
    # The default axis is horizontal and across the leg.
    np.testing.assert_allclose(np.linalg.norm(mechanism.base_joint_axes, axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(mechanism.base_joint_axes[:, 2], 0.0, atol=1e-14)
    np.testing.assert_allclose(np.sum(mechanism.base_joint_axes * mechanism.home_directions, axis=1), 0.0, atol=1e-14)


@given(seeds)
def test_a_base_may_have_any_attitude(seed: int) -> None:
    """The same mechanism in a turned frame {1}: directions of a given home turn with it, and frames stay frames."""
    base, platform = random_legs(seed)
    turn = Rotation.random(random_state=seed).as_matrix()
    height = np.array([0.0, 0.0, 0.35])
    level = Mechanism.from_legs(base, platform, home=Pose(height, np.eye(3)))
    turned = Mechanism.from_legs(base @ turn.T, platform, up_in_base=turn[:, 2], home=Pose(turn @ height, turn))
    np.testing.assert_allclose(turned.home_directions, level.home_directions @ turn.T, atol=1e-12)
    np.testing.assert_allclose(turned.up_in_base, turn[:, 2], atol=1e-15)
    falling = {"gravity": -9.81 * turn[:, 2]}
    without_home = Mechanism.from_legs(base @ turn.T, platform, up_in_base=turn[:, 2], plant=falling)
    for mechanism in (turned, without_home):
        across = np.sum(mechanism.base_joint_axes * mechanism.home_directions, axis=1)
        np.testing.assert_allclose(across, 0.0, atol=1e-12)


@given(seeds)
def test_joint_frames_are_rotations_with_z_nearest_the_home_direction(seed: int) -> None:
    base, platform = random_legs(seed)
    home = Pose(np.array([0.0, 0.0, 0.35]), np.eye(3))
    default = Mechanism.from_legs(base, platform, home=home)
    random = np.random.default_rng(seed)
    axes = random.normal(size=(6, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    along = np.abs(np.sum(axes * default.home_directions, axis=1)) > 0.9
    axes[along] = default.base_joint_axes[along]
    mechanism = Mechanism.from_legs(base, platform, base_joint_axes=axes, home=home)
    frames = mechanism.joint_rotations
    np.testing.assert_allclose(frames @ np.swapaxes(frames, 1, 2), np.tile(np.eye(3), (6, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, atol=1e-12)
    np.testing.assert_allclose(frames[:, :, 0], axes, atol=1e-12)
    # Of all directions across the axis, z has the greatest component along the leg.
    for angle in np.linspace(0.0, 2.0 * np.pi, 25):
        other = np.cos(angle) * frames[:, :, 2] + np.sin(angle) * frames[:, :, 1]
        dots = np.sum(other * mechanism.home_directions, axis=1)
        assert (dots <= np.sum(frames[:, :, 2] * mechanism.home_directions, axis=1) + 1e-12).all()


def test_upright_legs_have_a_first_axis_too() -> None:
    mechanism = Mechanism.from_legs(BASE, BASE)
    np.testing.assert_allclose(mechanism.home_directions, np.tile([0.0, 0.0, 1.0], (6, 1)), atol=1e-15)
    np.testing.assert_array_equal(mechanism.base_joint_axes, np.tile([1.0, 0.0, 0.0], (6, 1)))


def test_a_stroke_of_two_numbers_counts_from_home_and_of_twelve_is_absolute() -> None:
    relative = Mechanism.from_legs(BASE, PLATFORM, home=HOME, limits={"stroke": (-0.05, 0.04)})
    lengths = lengths_at(relative, HOME.position, HOME.rotation)
    np.testing.assert_allclose(relative.require_limits().stroke, np.column_stack([lengths - 0.05, lengths + 0.04]))
    rows = np.tile([0.3, 0.5], (6, 1))
    absolute = Mechanism.from_legs(BASE, PLATFORM, limits={"stroke": rows, "velocity": 1})
    np.testing.assert_array_equal(absolute.require_limits().stroke, rows)
    assert absolute.require_limits().velocity == 1.0


# ---- never changed ----


def arrays_of(mechanism: Mechanism) -> dict[str, Array]:
    home, limits = mechanism.require_home(), mechanism.require_limits()
    return {
        "base_joints": mechanism.base_joints,
        "platform_joints": mechanism.platform_joints,
        "base_joint_axes": mechanism.base_joint_axes,
        "home_directions": mechanism.home_directions,
        "up_in_base": mechanism.up_in_base,
        "home.position": home.position,
        "home.rotation": home.rotation,
        "limits.stroke": limits.stroke,
        "plant.gravity": mechanism.plant["gravity"],
    }


@pytest.mark.parametrize("name", list(arrays_of(load_mechanism("hexapod"))))
def test_arrays_of_a_mechanism_are_read_only(name: str) -> None:
    own = load_mechanism("hexapod")
    with pytest.raises(ValueError, match="read-only"):
        arrays_of(own)[name][...] = 0.0


def test_a_mechanism_does_not_follow_the_arrays_it_was_made_from() -> None:
    base = np.array(BASE)
    mechanism = Mechanism.from_legs(base, PLATFORM)
    base[:] = 0.0
    np.testing.assert_array_equal(mechanism.base_joints, BASE)


def test_fields_and_tables_of_a_mechanism_are_frozen(hexapod: Mechanism) -> None:
    with pytest.raises(AttributeError):
        hexapod.name = "other"  # type: ignore[misc]
    with pytest.raises(AttributeError):
        hexapod.require_limits().velocity = 1.0  # type: ignore[misc]
    with pytest.raises(TypeError):
        hexapod.plant["gravity"] = np.zeros(3)  # type: ignore[index]
    with pytest.raises(TypeError):
        hexapod.settings["control"]["hold"] = 0.0  # type: ignore[index]


# ---- refusals ----


@pytest.mark.parametrize(
    ("base", "platform", "message"),
    [
        (BASE[:5], PLATFORM, r"base_joints must have shape \(6, 3\), got \(5, 3\)"),
        (BASE, np.zeros((6, 2)), r"platform_joints must have shape \(6, 3\), got \(6, 2\)"),
        (changed(BASE, 2, [0.0, np.nan, 0.0]), PLATFORM, r"base_joints\[2, 1\] is nan; it must be finite"),
        (BASE, changed(PLATFORM, 4, [np.inf, 0.0, 0.0]), r"platform_joints\[4, 0\] is inf; it must be finite"),
        ("six joints", PLATFORM, "base_joints must be an array of numbers .* got 'six joints'"),
        ([[1.0], [2.0, 3.0]], PLATFORM, "base_joints must be an array of numbers"),
        (changed(BASE, 3, BASE[1]), changed(PLATFORM, 3, PLATFORM[1]), "legs 1 and 3 coincide: .* move one of them"),
        (np.outer(range(6), [1.0, 2.0, 3.0]), PLATFORM, "base joints all lie on one line"),
        (BASE, np.outer(range(6), [0.1, 0.0, 0.1]), "platform joints all lie on one line"),
    ],
)
def test_joints_that_cannot_be_used_are_refused(base: Any, platform: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Mechanism.from_legs(base, platform)


REFLECTION = np.diag([1.0, 1.0, -1.0])
ALONG = Mechanism.from_legs(BASE, PLATFORM, home=HOME).home_directions


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"up_in_base": [0.0, 0.0, 1.1]}, "up_in_base has length 1.1; it must be 1 within 0.001: normalise it"),
        ({"up_in_base": [0.0, 1.0]}, r"up_in_base must have shape \(3,\)"),
        ({"base_joint_axes": ALONG}, r"base_joint_axes\[\d\] lies within 8 deg of its leg .* turn the axis"),
        ({"base_joint_axes": 2.0 * np.eye(6)[:, :3]}, r"base_joint_axes\[0\] has length 2"),
        ({"base_joint_axes": np.ones(6)}, r"base_joint_axes must have shape \(6, 3\), got \(6,\)"),
        ({"home": Pose(HOME.position, REFLECTION)}, "home.rotation is a reflection"),
        ({"home": Pose(HOME.position, 1.01 * np.eye(3))}, "home.rotation is off orthogonal by 0.0201"),
        ({"home": Pose(np.full(3, np.nan), np.eye(3))}, r"home.position\[0\] is nan"),
        ({"home": Pose(np.array(BASE[2]) - PLATFORM[2], np.eye(3))}, "leg 2 has no length at home: move the home pose"),
        ({"limits": {"velocity": 1.0}}, "the limits lack the stroke"),
        ({"limits": {"stroke": [-0.1, 0.1]}}, "counts from the home lengths: give a home pose"),
        ({"home": HOME, "limits": {"stroke": [0.06, -0.06]}}, "the stroke of leg 0 runs from .* 0 < least < greatest"),
        ({"home": HOME, "limits": {"stroke": [-0.06, np.nan]}}, r"stroke\[.*1\] is nan"),
        ({"limits": {"stroke": np.tile([-0.1, 0.5], (6, 1))}}, "the stroke of leg 0 runs from -0.1 m to 0.5 m"),
        ({"home": HOME, "limits": {"stroke": [0.01, 0.06]}}, r"leg \d is 0.\d+ m long at home, outside its stroke"),
        (
            {"limits": {"stroke": np.ones((3, 2))}},
            r"stroke is \[\[1.0, 1.0\], .*; it must be two numbers about the home lengths, or 6 rows of absolute least",
        ),
        ({"home": HOME, "limits": {"stroke": 80}}, "stroke is 80.0; it must be two numbers about the home lengths, or 6 rows"),
        ({"home": HOME, "limits": {"stroke": [-0.1, 0.1], "velocity": 0.0}}, "limit of velocity is 0; it must be positive"),
        ({"home": HOME, "limits": {"stroke": [-0.1, 0.1], "jerk": "fast"}}, "limit of jerk must be .* got 'fast'"),
        ({"home": HOME, "limits": {"stroke": [-0.1, 0.1], "acceleration": np.inf}}, "acceleration is inf"),
        ({"plant": {"platform.mass": 0.0}}, "platform.mass is 0 kg; it must be 1e-09 to"),
        ({"plant": {"gravity": [0.0, -9.81]}}, r"gravity must have shape \(3,\)"),
        ({"plant": {"gravity": [0.0, 0.1, -9.81]}}, r"gravity .* does not point against up_in_base .*: make them agree"),
        ({"plant": {"gravity": [0.0, 0.0, 9.81]}}, "does not point against up_in_base"),
        ({"plant": {"motor.lead": 0.005}}, "no parameter 'motor.lead'; it has base_joints"),
    ],
)
def test_options_that_cannot_be_used_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises((InputError, UnknownNameError), match=message):
        Mechanism.from_legs(BASE, PLATFORM, **arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        {"home": HOME, "limits": {"stroke": [-0.1, 0.1], "speed": 1.0}},
        {"home": HOME, "limits": {"stroke": [[-0.1], [0.1, 0.2]]}},
        {"plant": {"platform.inertia": [[1.0], [1.0, 2.0]]}},
    ],
)
def test_unknown_limits_and_ragged_arrays_are_input_errors(arguments: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        Mechanism.from_legs(BASE, PLATFORM, **arguments)


def test_what_a_mechanism_lacks_is_named() -> None:
    bare = Mechanism.from_legs(BASE, PLATFORM, name="bare")
    with pytest.raises(InputError, match="'bare' has no home pose: give one"):
        bare.require_home()
    with pytest.raises(InputError, match="'bare' has no stroke: give one"):
        bare.require_limits()
    with pytest.raises(InputError, match="'bare' has no stroke"):
        bare.check_lengths(np.full(6, 0.4), "home")
    incomplete = Mechanism.from_legs(BASE, PLATFORM, home=HOME, limits={"stroke": [-0.1, 0.1]}, plant={"payload.mass": 1.0})
    with pytest.raises(InputError, match=r"lacks plant parameters: platform\.mass, .*substep") as caught:
        incomplete.plant_parameters()
    assert "payload.mass" not in str(caught.value)


def test_limits_do_not_accept_an_empty_stroke_on_their_own() -> None:
    with pytest.raises(InputError, match=r"the stroke of leg 5 runs from 0.4 m to 0.4 m"):
        Limits(np.vstack([np.tile([0.3, 0.5], (5, 1)), [0.4, 0.4]]))


def test_lengths_outside_the_stroke_name_leg_and_excess(hexapod: Mechanism) -> None:
    stroke = hexapod.require_limits().stroke
    inside = np.array([stroke[:, 0], stroke.mean(axis=1), stroke[:, 1]])
    hexapod.check_lengths(inside, "the target")
    too_long, too_short = inside.copy(), inside.copy()
    too_long[1, 4] = stroke[4, 1] + 0.0123
    too_long[2, 1] = stroke[1, 1] + 0.0100
    with pytest.raises(UnreachableError, match=r"the target needs leg 4 at 466\.\d\d mm, 12\.30 mm outside its stroke"):
        hexapod.check_lengths(too_long, "the target")
    too_short[0, 2] = stroke[2, 0] - 1e-4
    with pytest.raises(UnreachableError, match=r"the end needs leg 2 at .*, 0\.10 mm outside .* choose a smaller motion"):
        hexapod.check_lengths(too_short, "the end")


def test_a_built_mechanism_is_off_by_the_joint_error_and_shares_the_joints_it_shared() -> None:
    nominal = load_spatial("hexapod")
    moves = np.array(
        [
            np.stack([built.base_joints - nominal.base_joints, built.platform_joints - nominal.platform_joints])
            for built in (nominal.built(1e-4, seed) for seed in range(50))
        ]
    )
    assert 0.95e-4 < moves.std() < 1.05e-4
    np.testing.assert_array_equal(nominal.built(1e-4, 3).base_joints, nominal.built(1e-4, 3).base_joints)
    np.testing.assert_array_equal(nominal.built(0.0, 3).platform_joints, nominal.platform_joints)
    for preset in ("6-3-I", "6-4-II", "6-5"):
        shared = load_spatial(preset)
        np.testing.assert_array_equal(shared.built(1e-4, 0).distinct_joints(), shared.distinct_joints())
    with pytest.raises(InputError, match="the joint error is 100 mm; it must be at least 0 and below 30 mm"):
        nominal.built(0.1, 0)


def test_the_first_leg_with_the_same_joint_is_told() -> None:
    base = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    platform = np.array([[0.5, 0.1 * k, 0.0] if k else [0.2, 0.0, 0.0] for k in range(6)])
    mechanism = Mechanism.from_legs(base, platform)
    assert mechanism.distinct_joints().tolist() == [[0, 0, 2, 3, 3, 5], [0, 1, 2, 3, 4, 5]]


def test_the_first_leg_with_the_same_joint_is_told_for_the_platform_by_itself() -> None:
    platform = [PLATFORM[0], PLATFORM[1], PLATFORM[1], PLATFORM[3], PLATFORM[0], PLATFORM[5]]
    mechanism = Mechanism.from_legs(BASE, platform)
    assert mechanism.distinct_joints().tolist() == [[0, 1, 2, 3, 4, 5], [0, 1, 1, 3, 0, 5]]


def test_a_joint_error_is_measured_against_the_bases_radius_about_its_middle() -> None:
    """The middle of a base that is far from the origin of {1}; the error is refused from a tenth of the radius on."""
    far = Mechanism.from_legs(np.add(BASE, [5.0, 0.0, 0.0]), PLATFORM)
    middle = np.mean(BASE, axis=0)
    most = 0.1 * max(np.hypot(x - middle[0], y - middle[1]) for x, y, _ in BASE)
    far.built(0.999 * most, 0)
    for error in (most * (1.0 + 1e-9), -1e-6, np.nan):
        with pytest.raises(InputError, match=f"it must be at least 0 and below {1e3 * most:g} mm"):
            far.built(error, 0)


def test_base_and_platform_are_built_with_errors_of_their_own() -> None:
    nominal = load_spatial("hexapod")
    built, other = nominal.built(1e-4, 3), nominal.built(1e-4, 4)
    base, platform = built.base_joints - nominal.base_joints, built.platform_joints - nominal.platform_joints
    assert min(np.abs(base).min(), np.abs(platform).min(), np.abs(base - platform).min()) > 1e-9
    assert np.abs(other.base_joints - built.base_joints).min() > 1e-9
    np.testing.assert_allclose(nominal.built(3e-4, 3).base_joints - nominal.base_joints, 3.0 * base, atol=1e-15)
    np.testing.assert_array_equal(built.home_directions, nominal.home_directions)


def test_a_planar_mechanism_is_built_in_its_plane() -> None:
    nominal = load_in_space("planar-3rpr")
    built = nominal.built(1e-4, 2)
    for joints, before in ((built.base_joints, nominal.base_joints), (built.platform_joints, nominal.platform_joints)):
        np.testing.assert_array_equal(joints[:, 2], 0.0)
        assert np.abs(joints - before)[:, :2].min() > 1e-9


def test_joints_are_moved_on_their_own_side_and_must_stay_a_mechanism() -> None:
    nominal = Mechanism.from_legs(BASE, PLATFORM)
    moves = 1e-3 * np.arange(36.0).reshape(2, 6, 3)
    moved = nominal.moved_joints(moves)
    np.testing.assert_array_equal(moved.base_joints, np.array(BASE) + moves[0])
    np.testing.assert_array_equal(moved.platform_joints, np.array(PLATFORM) + moves[1])
    together = np.zeros((2, 6, 3))
    together[0, 1], together[1, 1] = np.subtract(BASE[0], BASE[1]), np.subtract(PLATFORM[0], PLATFORM[1])
    with pytest.raises(InputError, match="legs 0 and 1 coincide"):
        nominal.moved_joints(together)
    flat = np.zeros((2, 6, 3))
    flat[1, :, 0] = -np.array(PLATFORM)[:, 0]
    with pytest.raises(InputError, match="the platform joints all lie on one line"):
        nominal.moved_joints(flat)


def test_without_a_home_the_platform_is_over_the_base_along_the_vertical() -> None:
    """Its middle stands over the base's middle by 7/6 of the base's radius, on a base that is neither level nor centred."""
    up, shift, offset = np.array([0.48, -0.36, 0.8]), np.array([2.0, -1.0, 0.5]), np.array([0.3, 0.2, -0.1])
    base, platform = np.add(BASE, shift), np.add(PLATFORM, offset)
    mechanism = Mechanism.from_legs(base, platform, up_in_base=up)
    radius = np.linalg.norm(base - base.mean(axis=0), axis=1).max()
    home = mechanism.nominal_home
    np.testing.assert_array_equal(home.rotation, np.eye(3))
    middles = home.position + platform.mean(axis=0) - base.mean(axis=0)
    np.testing.assert_allclose(middles, 7.0 / 6.0 * radius * up, atol=1e-14)
    legs = home.position + platform - base
    np.testing.assert_allclose(mechanism.home_directions, legs / np.linalg.norm(legs, axis=1)[:, None], atol=1e-14)
    given = Mechanism.from_legs(base, platform, up_in_base=up, home=HOME)
    np.testing.assert_array_equal(given.nominal_home.position, HOME.position)


def test_home_directions_are_those_of_the_turned_platform() -> None:
    home = Pose(np.array([0.02, -0.03, 0.35]), Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix())
    mechanism = Mechanism.from_legs(BASE, PLATFORM, home=home)
    for k in range(LEGS):
        leg = home.position + home.rotation @ PLATFORM[k] - BASE[k]
        np.testing.assert_allclose(mechanism.home_directions[k], leg / np.linalg.norm(leg), atol=1e-15)
        across = np.cross([0.0, 0.0, 1.0], leg)
        np.testing.assert_allclose(mechanism.base_joint_axes[k], across / np.linalg.norm(across), atol=1e-15)


SKEWED = np.array([[0.10, 0.01, -0.02], [0.01, 0.07, 0.015], [-0.02, 0.015, 0.12]])


@pytest.mark.parametrize("body", ["platform", "payload"])
@pytest.mark.parametrize(
    "inertia",
    [SKEWED + [[0.0, 2e-9, 0.0], [0.0] * 3, [0.0] * 3], SKEWED - 0.07 * np.eye(3)],
    ids=["asymmetric", "a negative moment"],
)
def test_what_is_no_inertia_is_refused(body: str, inertia: Array) -> None:
    assert Mechanism.from_legs(BASE, PLATFORM, plant={f"{body}.inertia": SKEWED}).plant[f"{body}.inertia"][0, 2] == -0.02
    with pytest.raises(InputError, match=f"{body}.inertia .* is no inertia: it must be symmetric without negative principal"):
        Mechanism.from_legs(BASE, PLATFORM, plant={f"{body}.inertia": inertia})


def test_gravity_points_against_a_vertical_that_is_not_level_or_is_none() -> None:
    up = np.array([0.0, 0.6, 0.8])
    for gravity in (-9.81 * up, -1.62 * up, np.zeros(3)):
        made = Mechanism.from_legs(BASE, PLATFORM, up_in_base=up, plant={"gravity": gravity})
        np.testing.assert_array_equal(made.plant["gravity"], gravity)
    for gravity in (9.81 * up, [0.0, 0.0, -9.81], [0.02, -5.886, -7.848]):
        with pytest.raises(InputError, match="does not point against up_in_base"):
            Mechanism.from_legs(BASE, PLATFORM, up_in_base=up, plant={"gravity": gravity})


# ---- planar mechanisms in space ----

PLANAR_BASE, PLANAR_PLATFORM = [[0.0, 0.0], [0.2, 0.0], [0.3, 0.1]], [[0.0, 0.0], [0.1, 0.0], [0.05, 0.08]]


def planar_in_space(**options: Any) -> Mechanism:
    home = PlanarPose(np.array([0.05, 0.2]), 0.4)
    return Mechanism.from_planar(PlanarMechanism.from_legs(PLANAR_BASE, PLANAR_PLATFORM, home=home, **options))


def test_a_planar_mechanism_lies_in_the_xy_plane_of_space() -> None:
    seen = planar_in_space(name="flat", limits={"stroke": [-0.02, 0.03]}, settings={"safety": {"a": 1.0}})
    assert (seen.name, seen.legs, seen.planar, seen.settings["safety"]) == ("flat", 3, True, {"a": 1.0})
    np.testing.assert_array_equal(seen.base_joints, [[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.3, 0.1, 0.0]])
    np.testing.assert_array_equal(seen.platform_joints, [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.05, 0.08, 0.0]])
    home = seen.require_home()
    np.testing.assert_array_equal(home.position, [0.05, 0.2, 0.0])
    np.testing.assert_allclose(home.rotation, Rotation.from_rotvec([0.0, 0.0, 0.4]).as_matrix(), atol=1e-15)
    lengths = lengths_at(seen, home.position, home.rotation)
    np.testing.assert_allclose(seen.require_limits().stroke, lengths[:, None] + [-0.02, 0.03], atol=1e-15)
    legs = home.position + seen.platform_joints @ home.rotation.T - seen.base_joints
    np.testing.assert_allclose(seen.home_directions, legs / lengths[:, None], atol=1e-15)
    # A joint's frame has the plane's normal as x, the leg at home as z, and y across both.
    normal = np.tile([0.0, 0.0, 1.0], (3, 1))
    frames = np.stack([normal, np.cross(seen.home_directions, normal), seen.home_directions], axis=2)
    np.testing.assert_allclose(seen.joint_rotations, frames, atol=1e-15)


@pytest.mark.parametrize(
    ("gravity", "up"),
    [
        (None, [0.0, 1.0, 0.0]),
        ([3.0, -4.0, 0.0], [-0.6, 0.8, 0.0]),
        ([0.0, -6.0, -8.0], [0.0, 0.6, 0.8]),
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
    ],
)
def test_the_vertical_of_a_planar_mechanism_is_against_its_gravity(gravity: list[float] | None, up: list[float]) -> None:
    seen = planar_in_space(plant={} if gravity is None else {"gravity": gravity})
    np.testing.assert_allclose(seen.up_in_base, up, atol=1e-15)


@pytest.mark.parametrize("angle", [2.5, -3.0, 0.3])
def test_the_planar_plant_starts_at_the_pose_asked_for(angle: float) -> None:
    rig = load_in_space("planar-3rpr")
    start = Pose(np.array([0.11, 0.21, 0.0]), Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix())
    p = rig.plant_parameters(start)
    assert p["initial_angle"] == pytest.approx(angle, abs=1e-15)
    np.testing.assert_array_equal(p["initial_position"], [0.11, 0.21])
    np.testing.assert_array_equal(p["base_joints"], rig.base_joints[:, :2])
    stroke = rig.require_limits().stroke
    np.testing.assert_allclose(p["stop.minimum_length"], stroke[:, 0] - 0.002, atol=1e-15)
    np.testing.assert_allclose(p["stop.maximum_length"], stroke[:, 1] + 0.002, atol=1e-15)


def test_lengths_of_three_legs_are_checked_as_those_of_six() -> None:
    rig = load_in_space("planar-3rpr")
    stroke = rig.require_limits().stroke
    rig.check_lengths(stroke.T, "the ends")
    with pytest.raises(UnreachableError, match=r"the path needs leg 2 at .*, 4\.00 mm outside its stroke"):
        rig.check_lengths(np.stack([stroke[:, 0], stroke[:, 0] - [0.001, 0.003, 0.004]]), "the path")


def test_rows_of_missing_legs_are_filled() -> None:
    np.testing.assert_array_equal(six_rows(np.array([1.0, 2.0, 3.0]), 7.0), [1.0, 2.0, 3.0, 7.0, 7.0, 7.0])
    np.testing.assert_array_equal(six_rows(np.ones((3, 2))), [[1.0, 1.0]] * 3 + [[0.0, 0.0]] * 3)
    np.testing.assert_array_equal(six_rows(np.arange(12.0).reshape(6, 2), [8.0, 9.0]), np.arange(12.0).reshape(6, 2))
