r"""Classes of mechanisms: which legs share a joint (the paper's sections 2 and 6).

A combinatorial class is a bipartite graph: its edges (base joint, platform joint) are the legs, and the numbering of the
joints on either side does not matter. Base and platform are not exchanged. No joint carries more than three legs and no two
legs share both joints. This leaves 60 classes of six legs in space and four of three legs in the plane.

The drawing of a class is a line of text, one connected component after the other, base joints below and platform joints above.
`|` is a leg, `∧` and `∨` are two legs that meet above and below, `N`, `M` and `W` three and four in a row, `⩚` and `⩛` three
that meet above and below; a superscript repeats. Any other component is a zigzag of `/` up and `\` down, in square brackets if
it ends where it began, else in round ones. In a zigzag, `|` is a leg that branches off, and inner round brackets are two legs
in a row that branch off.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations, groupby, pairwise, permutations, product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plant.errors import InputError
from plant.mechanism import LEGS, Mechanism
from plant.mechanism.checks import SAME_JOINT_M
from plant.mechanism.planar import PLANAR_LEGS, PlanarMechanism
from plant.pose import Array, numbers, rotation_from_vector

MOST_LEGS = 3
"""The most legs at one joint."""
LEAST_JOINTS = {LEGS: 3, PLANAR_LEGS: 2}
"""The fewest joints on a side, by the number of legs."""

Legs = tuple[tuple[int, int], ...]
"""The base joint and the platform joint of each leg."""
Joint = tuple[str, int]
"""A side, "base" or "platform", and the joint's number on it."""
Neighbours = dict[Joint, list[Joint]]

_GLYPHS = {"/": "|", "/\\": "∧", "\\/": "∨", "/\\/": "N", "/\\/\\": "M", "\\/\\/": "W", "/|\\": "⩚", "\\|/": "⩛"}
_SUPERSCRIPTS = ("", "", *"²³⁴⁵⁶")


@dataclass(frozen=True)
class MechanismClass:
    """A combinatorial class; equal graphs are equal classes, however they are numbered.

    The joints of `legs` may be given by any numbers; they are stored by canonical ones, from 0 on either side.

    Raises:
        InputError: another number of legs, legs that share both joints, a joint of too many legs, or too few joints.
    """

    legs: Legs

    def __post_init__(self) -> None:
        _check(self.legs)
        object.__setattr__(self, "legs", _canonical(self.legs))

    @property
    def planar(self) -> bool:
        """Whether the class has three legs in the plane."""
        return len(self.legs) == PLANAR_LEGS

    @property
    def base_degrees(self) -> tuple[int, ...]:
        """The number of legs of each base joint, the most first."""
        return tuple(sorted(Counter(base for base, _ in self.legs).values(), reverse=True))

    @property
    def platform_degrees(self) -> tuple[int, ...]:
        """The number of legs of each platform joint, the most first."""
        return tuple(sorted(Counter(platform for _, platform in self.legs).values(), reverse=True))

    @property
    def base_count(self) -> int:
        """The number of base joints, the paper's n."""
        return len(self.base_degrees)

    @property
    def platform_count(self) -> int:
        """The number of platform joints, the paper's m."""
        return len(self.platform_degrees)

    @property
    def type(self) -> str:
        """The paper's type: with three or four platform joints in space, "II" if one has three legs, else "I"."""
        if self.planar or self.platform_count > 4:
            return ""
        return "II" if self.platform_degrees[0] == MOST_LEGS else "I"

    @property
    def group(self) -> str:
        """The paper's group, such as "n-4-II", which does not depend on the base joints."""
        return f"n-{self.platform_count}" + (f"-{self.type}" if self.type else "")

    @property
    def name(self) -> str:
        """The numbers of joints, such as "6-4-II" or "planar 3-2"."""
        return ("planar " if self.planar else "") + self.group.replace("n", str(self.base_count), 1)

    @property
    def number(self) -> int:
        """The place within the group, from 1."""
        classes = planar_classes() if self.planar else spatial_classes()
        return [peer for peer in classes if peer.group == self.group].index(self) + 1

    @property
    def label(self) -> str:
        """Group and number, such as "n-4-II.3" or "planar n-3.1", different for every class."""
        return f"{'planar ' if self.planar else ''}{self.group}.{self.number}"

    @property
    def drawing(self) -> str:
        """The graph as a line of text (see the module), different for every class."""
        glyphs = Counter(_GLYPHS.get(zigzag, zigzag if zigzag[0] == "[" else f"({zigzag})") for zigzag, _ in _components(self))
        return "".join(glyph + _SUPERSCRIPTS[count] for glyph, count in glyphs.items())


def joint_numbers(joints: ArrayLike, name: str = "joints") -> NDArray[np.intp]:
    """The number (6,) or (3,) of each leg's joint, from 0 in the order of first appearance.

    The joints are (6, 3) in space or (3, 2) in the plane [m]; those within `SAME_JOINT_M` are one.

    Raises:
        InputError: joints of another shape, or not finite.
    """
    points = numbers(joints, name, "(6, 3) or (3, 2)")
    if points.shape not in ((LEGS, 3), (PLANAR_LEGS, 2)):
        raise InputError(f"{name} has shape {points.shape}; give (6, 3) for six legs in space, (3, 2) for three in the plane")
    if not np.isfinite(points).all():
        raise InputError(f"{name} has a coordinate that is not finite: {points.tolist()}")
    same = np.linalg.norm(points[:, None] - points, axis=2) < SAME_JOINT_M
    return np.unique(same.argmax(axis=1), return_inverse=True)[1]


def classify(mechanism: Mechanism | PlanarMechanism) -> MechanismClass:
    """The combinatorial class of a mechanism; joints within `SAME_JOINT_M` are one.

    Raises:
        InputError: as `joint_numbers` and `MechanismClass`.
    """
    return MechanismClass(_legs(mechanism))


def canonical_legs(mechanism: Mechanism | PlanarMechanism) -> Legs:
    """The joints of each leg of a mechanism, in the order of its legs and the numbers of its class.

    Raises:
        InputError: as `classify`.
    """
    own = _legs(mechanism)
    bases, platforms = zip(*own, strict=True)

    def same(legs: Legs) -> bool:
        sides = zip((bases, platforms), zip(*legs, strict=True), strict=True)
        return all(len(set(zip(mine, theirs, strict=True))) == len(set(mine)) for mine, theirs in sides)

    return next(legs for legs in permutations(MechanismClass(own).legs) if same(legs))


@cache
def spatial_classes() -> tuple[MechanismClass, ...]:
    """The 60 classes of six legs, by platform joints, type, and base joints (section 2)."""
    return _classes(LEGS)


@cache
def planar_classes() -> tuple[MechanismClass, ...]:
    """The four classes of three legs in the plane, in the order of `spatial_classes` (section 6)."""
    return _classes(PLANAR_LEGS)


def draw_mechanism(
    mechanism_class: MechanismClass,
    random: np.random.Generator,
    *,
    coplanar: bool = True,
    up_in_base: ArrayLike = (0.0, 0.0, 1.0),
) -> Mechanism:
    """A random mechanism of a spatial class, of desk size, with legs and joints in random order.

    The base joints lie near a ring of 0.3 m; the platform joints near one of 0.2 m, in a plane if they are `coplanar`.

    Raises:
        InputError: the class is planar, or the vertical is not a unit vector.
    """
    if mechanism_class.planar:
        raise InputError(f"{mechanism_class.label} has three legs in the plane; draw one of the spatial classes")
    base_places = random.permutation(mechanism_class.base_count)
    platform_places = random.permutation(mechanism_class.platform_count)
    base = _ring(base_places, 0.3, random.uniform(-0.05, 0.05, base_places.size), random)
    heights = 0.0 if coplanar else (-1.0) ** platform_places * random.uniform(0.03, 0.06, platform_places.size)
    platform = _ring(platform_places, 0.2, heights, random)
    offset = random.uniform([-0.05, -0.05, 0.02], [0.05, 0.05, 0.06])
    platform = (offset + platform) @ rotation_from_vector(random.uniform(-0.5, 0.5, 3)).T
    legs = random.permutation(mechanism_class.legs)
    return Mechanism.from_legs(
        base[legs[:, 0]], platform[legs[:, 1]], name=f"a random {mechanism_class.label}", up_in_base=up_in_base
    )


def draw_planar_mechanism(mechanism_class: MechanismClass, random: np.random.Generator) -> PlanarMechanism:
    """A random mechanism of a planar class, near circles of 0.3 m and 0.1 m.

    Raises:
        InputError: the class is spatial.
    """
    if not mechanism_class.planar:
        raise InputError(f"{mechanism_class.label} has six legs in space; draw one of the planar classes")
    base, platform = (
        _ring(random.permutation(count), radius, 0.0, random)[:, :2]
        for count, radius in ((mechanism_class.base_count, 0.3), (mechanism_class.platform_count, 0.1))
    )
    legs = random.permutation(mechanism_class.legs)
    return PlanarMechanism.from_legs(base[legs[:, 0]], platform[legs[:, 1]], name=f"a random {mechanism_class.label}")


def layout(mechanism_class: MechanismClass) -> tuple[Array, Array]:
    """Places of the joints (n,) and (m,) in a picture of two rows with the fewest crossings of legs."""
    x: dict[Joint, float] = {}
    left = 0.0
    for _, joints in _components(mechanism_class):
        rows = [[joint for joint in joints if joint[0] == side] for side in ("base", "platform")]
        legs = [leg for leg in _leg_joints(mechanism_class.legs) if leg[0] in joints]
        width = max(map(len, rows))
        places = (
            {joint: left + (width - len(row)) / 2.0 + i for row in order for i, joint in enumerate(row)}
            for order in product(*map(permutations, rows))
        )
        x |= min(places, key=lambda place: _entanglement([(place[base], place[platform]) for base, platform in legs]))
        left += width
    base, platform = ([x[joint] for joint in sorted(x) if joint[0] == side] for side in ("base", "platform"))
    return np.array(base), np.array(platform)


def _legs(mechanism: Mechanism | PlanarMechanism) -> Legs:
    base = joint_numbers(mechanism.base_joints, "base_joints")
    platform = joint_numbers(mechanism.platform_joints, "platform_joints")
    if len(base) != len(platform):
        raise InputError(f"{len(base)} legs start in base_joints and {len(platform)} end in platform_joints: give as many")
    return tuple(zip(base.tolist(), platform.tolist(), strict=True))


def _check(legs: Legs) -> None:
    if len(legs) not in LEAST_JOINTS:
        raise InputError(f"there are {len(legs)} legs; a class has six in space or three in the plane: give as many")
    for (leg, joints), (other, others) in combinations(enumerate(legs), 2):
        if joints == others:
            raise InputError(f"legs {leg} and {other} share both joints: move one of them")
    for side, joints in zip(("base", "platform"), zip(*legs, strict=True), strict=True):
        joint, count = Counter(joints).most_common(1)[0]
        if count > MOST_LEGS:
            shared = ", ".join(str(leg) for leg, other in enumerate(joints) if other == joint)
            raise InputError(f"legs {shared} share a {side} joint, which carries {MOST_LEGS} at most: move some of them")
        least, there = LEAST_JOINTS[len(legs)], len(set(joints))
        if there < least:
            raise InputError(f"the number of {side} joints is {there}; {len(legs)} legs need {least} at least: move some apart")


def _leg_joints(legs: Legs) -> list[tuple[Joint, Joint]]:
    return [(("base", base), ("platform", platform)) for base, platform in legs]


def _neighbours(legs: Legs) -> Neighbours:
    neighbours: Neighbours = {}
    for base, platform in _leg_joints(legs):
        neighbours.setdefault(base, []).append(platform)
        neighbours.setdefault(platform, []).append(base)
    return neighbours


def _canonical(legs: Legs) -> Legs:
    """The smallest numbering with joints of many legs first."""
    neighbours = _neighbours(legs)

    def rank(joint: Joint) -> list[int]:
        """Minus the number of legs of the joint, then of each neighbour."""
        return [-len(neighbours[joint]), *sorted(-len(neighbours[other]) for other in neighbours[joint])]

    def numbered(order: Sequence[Joint]) -> Legs:
        number = {joint: i for i, joint in enumerate(order)}
        bases = (sorted(number[base] for base in neighbours[joint]) for joint in neighbours if joint[0] == "platform")
        rows = sorted(bases, key=lambda row: (-len(row), row))
        return tuple(sorted((base, platform) for platform, row in enumerate(rows) for base in row))

    alike = groupby(sorted((joint for joint in neighbours if joint[0] == "base"), key=rank), key=rank)
    orders = product(*(permutations(joints) for _, joints in alike))
    return min(numbered([joint for joints in order for joint in joints]) for order in orders)


def _classes(leg_count: int) -> tuple[MechanismClass, ...]:
    graphs: set[Legs] = {((0, 0),)}
    for _ in range(leg_count - 1):
        graphs = {_canonical((*legs, leg)) for legs in graphs for leg in _additional_legs(legs)}
    least = LEAST_JOINTS[leg_count]
    classes = (MechanismClass(legs) for legs in graphs if min(len(set(side)) for side in zip(*legs, strict=True)) >= least)
    return tuple(sorted(classes, key=lambda each: (each.platform_count, each.type, -each.base_count, each.legs)))


def _additional_legs(legs: Legs) -> Iterator[tuple[int, int]]:
    base_degrees, platform_degrees = (Counter(side) for side in zip(*legs, strict=True))
    for base, platform in product(range(len(base_degrees) + 1), range(len(platform_degrees) + 1)):
        if (base, platform) not in legs and max(base_degrees[base], platform_degrees[platform]) < MOST_LEGS:
            yield base, platform


def _paths(neighbours: Neighbours, start: Joint, avoided: Sequence[Joint] = ()) -> list[tuple[Joint, ...]]:
    """Every path from a joint that visits no joint twice, short paths first."""
    paths: list[tuple[Joint, ...]] = [(start,)]
    for path in paths:
        paths += [(*path, joint) for joint in neighbours[path[-1]] if joint not in path and joint not in avoided]
    return paths


def _components(mechanism_class: MechanismClass) -> list[tuple[str, list[Joint]]]:
    """The zigzag of each connected component and its joints, large components first."""
    neighbours = _neighbours(mechanism_class.legs)
    components = []
    left = set(neighbours)
    while left:
        joints = {joint for path in _paths(neighbours, min(left)) for joint in path}
        components.append(_zigzag(neighbours, joints))
        left -= joints
    return sorted(components, key=lambda component: (-len(component[1]), component[0]))


def _zigzag(neighbours: Neighbours, joints: set[Joint]) -> tuple[str, list[Joint]]:
    """The strokes along the cycle of a component, or along its longest path, with branches early."""
    paths = [path for joint in joints for path in _paths(neighbours, joint)]
    cycles = [(*path, path[0]) for path in paths if len(path) > 2 and path[0] in neighbours[path[-1]]]
    trunks = cycles or paths
    longest = max(map(len, trunks))
    spellings = (_strokes(neighbours, trunk) for trunk in trunks if len(trunk) == longest)
    strokes, order = min(spellings, key=lambda spelling: (spelling[0].replace("|", "!"), spelling[1]))
    return (f"[{strokes}]" if cycles else strokes), order


def _strokes(neighbours: Neighbours, trunk: Sequence[Joint]) -> tuple[str, list[Joint]]:
    """The strokes along a trunk and its branches, and the joints in that order."""
    strokes, order = "", [trunk[0]]
    for tail, head in pairwise(trunk):
        branch = _paths(neighbours, head, trunk)[-1]
        twig = "|" if len(branch) == 2 else f"({_strokes(neighbours, branch)[0]})" if len(branch) > 2 else ""
        strokes += ("/" if tail[0] == "base" else "\\") + twig
        order += [joint for joint in (head, *branch[1:]) if joint not in order]
    return strokes, order


def _entanglement(legs: Sequence[tuple[float, float]]) -> tuple[int, float]:
    """The number of crossings of legs (x below, x above), and the sum of their leans."""
    crossings = sum((base - other) * (platform - another) < 0.0 for (base, platform), (other, another) in combinations(legs, 2))
    return crossings, sum(abs(base - platform) for base, platform in legs)


def _ring(places: NDArray[np.intp], radius: float, heights: ArrayLike, random: np.random.Generator) -> Array:
    """Joints (count, 3) [m] near places 0, 1, ... around a ring."""
    angles = 2.0 * np.pi * (places + random.uniform(-0.25, 0.25, places.size)) / places.size
    radii = radius * random.uniform(0.85, 1.15, places.size)
    return np.column_stack([radii * np.cos(angles), radii * np.sin(angles), np.broadcast_to(heights, places.size)])
