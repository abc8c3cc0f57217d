"""The layout of an exported plant, and its XML: modelDescription.xml and buildDescription.xml.

In FMI 3.0 each variable of the table is one variable, whose value reference is its index in `Layout.exposed`. In FMI 2.0 each
element is one, such as `base_joints[1,3]`, whose value reference is its place in the vector of all values.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from plant.dynamics.variables import BRAKE, DRIVE_MODES, Variable, VariableTable
from plant.fmu.description_reader import element_names
from plant.pose import Array

QUANTITIES: dict[str, tuple[str, dict[str, int | str]]] = {
    "m": ("Length", {"m": 1}),
    "m/s": ("Velocity", {"m": 1, "s": -1}),
    "m/s2": ("Acceleration", {"m": 1, "s": -2}),
    "rad": ("Angle", {"rad": 1}),
    "rad/s": ("AngularVelocity", {"rad": 1, "s": -1}),
    "rad/s2": ("AngularAcceleration", {"rad": 1, "s": -2}),
    "rad/N.m": ("RotationalCompliance", {"rad": 1, "kg": -1, "m": -2, "s": 2}),
    "1/s": ("Frequency", {"s": -1}),
    "A/s": ("ElectricCurrentSlope", {"A": 1, "s": -1}),
    "kg": ("Mass", {"kg": 1}),
    "kg.m2": ("MomentOfInertia", {"kg": 1, "m": 2}),
    "s": ("Time", {"s": 1}),
    "s/m": ("InverseVelocity", {"s": 1, "m": -1}),
    "N": ("Force", {"kg": 1, "m": 1, "s": -2}),
    "N.m": ("Torque", {"kg": 1, "m": 2, "s": -2}),
    "N.s/m": ("TranslationalDampingConstant", {"kg": 1, "s": -1}),
    "N/m": ("TranslationalSpringConstant", {"kg": 1, "s": -2}),
    "Ohm": ("Resistance", {"kg": 1, "m": 2, "s": -3, "A": -2}),
    "H": ("Inductance", {"kg": 1, "m": 2, "s": -2, "A": -2}),
    "N.m/A": ("ElectricalTorqueConstant", {"kg": 1, "m": 2, "s": -2, "A": -1}),
    "V": ("Voltage", {"kg": 1, "m": 2, "s": -3, "A": -1}),
    "A": ("ElectricCurrent", {"A": 1}),
    "J": ("Energy", {"kg": 1, "m": 2, "s": -2}),
    "W": ("Power", {"kg": 1, "m": 2, "s": -3}),
    "uT": ("MagneticFluxDensity", {"kg": 1, "s": -2, "A": -1, "factor": "1e-6"}),
    "1": ("Dimensionless", {}),
}
"""The quantity that each unit measures, and its exponents of the SI base units."""

_PER_SECOND = {"m": "m/s", "m/s": "m/s2", "rad": "rad/s", "rad/s": "rad/s2", "1": "1/s", "A": "A/s"}
"""The units of the states' derivatives."""


@dataclass(frozen=True)
class Layout:
    """The values of a plant in one vector."""

    table: VariableTable

    @cached_property
    def rates(self) -> tuple[Variable, ...]:
        """The derivatives of the states."""
        return tuple(
            replace(
                state, name=f"der({state.name})", unit=_PER_SECOND[state.unit], description=f"derivative of {state.name}",
                minimum=-1e9, maximum=1e9,
            )
            for state in self.table.states
        )  # fmt: skip

    @cached_property
    def exposed(self) -> tuple[Variable, ...]:
        """The variables of the FMU, in the order of their value references in FMI 3.0."""
        table = self.table
        return (*table.inputs, *table.parameters, *table.outputs, *table.states, *self.rates)

    @cached_property
    def stored(self) -> tuple[Variable, ...]:
        """The variables in the order of their values."""
        table = self.table
        return (*table.states, *table.inputs, *table.parameters, *table.outputs, *self.rates)

    @cached_property
    def offsets(self) -> Mapping[str, int]:
        """The place of each variable's first value, by its name."""
        offsets, at = {}, 0
        for variable in self.stored:
            offsets[variable.name] = at
            at += variable.size
        return offsets

    @property
    def size(self) -> int:
        """The number of values."""
        return sum(variable.size for variable in self.stored)

    def state_of(self, variable: Variable) -> Variable | None:
        """The state whose derivative a variable is, or None."""
        return self.table.states[self.rates.index(variable)] if variable in self.rates else None

    def places(self, variable: Variable) -> range:
        """The places of a variable's values."""
        return range(self.offsets[variable.name], self.offsets[variable.name] + variable.size)


class Dependencies(NamedTuple):
    """What depends on what, by the places of their values."""

    running: Mapping[int, frozenset[int]]  # outputs and derivatives on states and inputs
    initial: Mapping[int, frozenset[int]]  # these and states on parameters and inputs


def start_of(variable: Variable, starts: Mapping[str, Array]) -> list[float]:
    """The start values of a variable: drives on their brakes, other inputs zero."""
    if variable.discrete:
        return [float(BRAKE)] * variable.size
    if variable.causality == "parameter":
        return [float(value) for value in starts[variable.name].reshape(-1)]
    return [0.0] * variable.size


def build_description(identifier: str, sources: list[str]) -> bytes:
    """The instructions to compile the FMU: sources/buildDescription.xml of FMI 3.0."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    description = "any C99 compiler; without -ffast-math"
    configuration = SubElement(root, "BuildConfiguration", modelIdentifier=identifier, description=description)
    files = SubElement(configuration, "SourceFileSet", language="C99")
    for name in sources:
        SubElement(files, "SourceFile", name=name)
    return _document(root)


def model_description(
    fmi: int,
    identifier: str,
    description: str,
    layout: Layout,
    starts: Mapping[str, Array],
    token: str,
    dependencies: Dependencies,
    sources: list[str],
) -> bytes:
    """The content of modelDescription.xml."""
    writer = (_Fmi3 if fmi == 3 else _Fmi2)(layout, starts, dependencies)
    root = Element(
        "fmiModelDescription",
        writer.head(token)
        | {
            "modelName": identifier, "description": description, "generationTool": "gough",
            "variableNamingConvention": "structured",
        },
    )  # fmt: skip
    writer.add_interfaces(root, identifier, sources)
    units = SubElement(root, "UnitDefinitions")
    for unit in sorted({variable.unit for variable in layout.exposed} | {"s"}):
        bases = {base: str(exponent) for base, exponent in QUANTITIES[unit][1].items()}
        SubElement(SubElement(units, "Unit", name=unit), "BaseUnit", bases)
    writer.add_types(root)
    categories = SubElement(root, "LogCategories")
    SubElement(categories, "Category", name="logStatusError", description="why a call was refused or failed")
    SubElement(root, "DefaultExperiment", startTime="0", stopTime="10", stepSize="0.001")
    writer.add_variables(SubElement(root, "ModelVariables"))
    writer.add_structure(SubElement(root, "ModelStructure"))
    return _document(root)


def _document(root: Element) -> bytes:
    indent(root)
    document: bytes = tostring(root, encoding="UTF-8", xml_declaration=True)
    return document + b"\n"


def _words(numbers: Iterable[int]) -> str:
    return " ".join(map(str, sorted(numbers)))


_TIME = {
    "causality": "independent", "variability": "continuous", "quantity": "Time", "unit": "s", "description": "simulation time",
}  # fmt: skip
_STEPS = {"canHandleVariableCommunicationStepSize": "true"}


@dataclass
class _Writer:
    """Common to both versions of FMI."""

    layout: Layout
    starts: Mapping[str, Array]
    dependencies: Dependencies

    def add_types(self, root: Element) -> None:
        """FMI 2.0 needs none."""

    def role(self, variable: Variable) -> dict[str, str]:
        """Causality and variability."""
        causality = "local" if variable.causality == "state" else variable.causality
        if variable.causality == "parameter":
            return {"causality": causality, "variability": "tunable" if variable.tunable else "fixed"}
        return {"causality": causality, "variability": "discrete" if variable.discrete else "continuous"}

    def initial(self, variable: Variable) -> dict[str, str]:
        return {"initial": "calculated"} if variable.causality in ("state", "output") else {}

    def bounds(self, variable: Variable) -> dict[str, str]:
        """Quantity, unit and bounds."""
        limits = {"min": repr(variable.minimum), "max": repr(variable.maximum)}
        if variable.discrete:
            return limits
        return {"quantity": QUANTITIES[variable.unit][0], "unit": variable.unit, **limits, "nominal": repr(variable.nominal)}

    def start(self, variable: Variable) -> list[str]:
        """The start values as text; none for calculated variables."""
        if self.initial(variable):
            return []
        values = start_of(variable, self.starts)
        return [str(int(value)) if variable.discrete else repr(value) for value in values]

    def unknowns(self) -> Iterator[tuple[str, Variable, Mapping[int, frozenset[int]]]]:
        """Kind, variable and dependencies of each unknown, in the standard's order."""
        table, rates, dependencies = self.layout.table, self.layout.rates, self.dependencies
        for kind, variables in (("Output", table.outputs), ("Derivative", rates)):
            for variable in variables:
                yield kind, variable, dependencies.running
        for variable in (*table.outputs, *table.states, *rates):
            yield "InitialUnknown", variable, dependencies.initial


class _Fmi3(_Writer):
    def head(self, token: str) -> dict[str, str]:
        return {"fmiVersion": "3.0", "instantiationToken": token}

    def add_interfaces(self, root: Element, identifier: str, _: list[str]) -> None:
        abilities = (
            "canGetAndSetFMUState", "canSerializeFMUState", "providesDirectionalDerivatives", "providesAdjointDerivatives",
        )  # fmt: skip
        able = {"modelIdentifier": identifier, **dict.fromkeys(abilities, "true")}
        SubElement(root, "ModelExchange", able)
        SubElement(root, "CoSimulation", able | _STEPS)

    def add_types(self, root: Element) -> None:
        modes = SubElement(SubElement(root, "TypeDefinitions"), "EnumerationType", name="DriveMode")
        for value, name in DRIVE_MODES.items():
            SubElement(modes, "Item", name=name, value=str(value))

    def add_variables(self, parent: Element) -> None:
        exposed = self.layout.exposed
        SubElement(parent, "Float64", {"name": "time", "valueReference": str(len(exposed)), **_TIME})
        for reference, variable in enumerate(exposed):
            attributes = {"name": variable.name, "valueReference": str(reference)}
            attributes |= self.role(variable) | self.bounds(variable)
            if start := self.start(variable):
                attributes["start"] = " ".join(start)
            if variable.discrete:
                attributes["declaredType"] = "DriveMode"
            attributes |= self.initial(variable)
            if (state := self.layout.state_of(variable)) is not None:
                attributes["derivative"] = str(exposed.index(state))
            attributes["description"] = variable.description
            element = SubElement(parent, "Enumeration" if variable.discrete else "Float64", attributes)
            for length in variable.shape:
                SubElement(element, "Dimension", start=str(length))

    def add_structure(self, parent: Element) -> None:
        exposed = self.layout.exposed
        references = {place: i for i, variable in enumerate(exposed) for place in self.layout.places(variable)}
        for kind, variable, dependencies in self.unknowns():
            known = {references[k] for place in self.layout.places(variable) for k in dependencies[place]}
            tag = "ContinuousStateDerivative" if kind == "Derivative" else kind
            SubElement(parent, tag, valueReference=str(exposed.index(variable)), dependencies=_words(known))


class _Fmi2(_Writer):
    def head(self, token: str) -> dict[str, str]:
        return {"fmiVersion": "2.0", "guid": token, "numberOfEventIndicators": "0"}

    def add_interfaces(self, root: Element, identifier: str, sources: list[str]) -> None:
        abilities = (
            "canNotUseMemoryManagementFunctions", "canGetAndSetFMUstate", "canSerializeFMUstate",
            "providesDirectionalDerivative",
        )  # fmt: skip
        able = {"modelIdentifier": identifier, **_STEPS, **dict.fromkeys(abilities, "true")}
        files = SubElement(SubElement(root, "CoSimulation", able), "SourceFiles")
        for name in sources:
            SubElement(files, "File", name=name)

    @cached_property
    def _index(self) -> dict[int, int]:
        """The index of each scalar, counted from 1, by its place."""
        places = [place for variable in self.layout.exposed for place in self.layout.places(variable)]
        return {place: index for index, place in enumerate(places, start=1)}

    def add_variables(self, parent: Element) -> None:
        for variable in self.layout.exposed:
            starts, state, places = self.start(variable), self.layout.state_of(variable), self.layout.places(variable)
            for i, name in enumerate(element_names(variable.name, variable.shape)):
                scalar = {"name": name, "valueReference": str(places[i]), **self.role(variable), **self.initial(variable)}
                element = SubElement(parent, "ScalarVariable", scalar, description=variable.description)
                attributes = self.bounds(variable)
                if starts:
                    attributes["start"] = starts[i]
                if state is not None:
                    attributes["derivative"] = str(self._index[self.layout.places(state)[i]])
                # Some importers cannot set an enumeration.
                SubElement(element, "Integer" if variable.discrete else "Real", attributes)

    def add_structure(self, parent: Element) -> None:
        lists = {kind: SubElement(parent, f"{kind}s") for kind in ("Output", "Derivative", "InitialUnknown")}
        for kind, variable, dependencies in self.unknowns():
            for place in self.layout.places(variable):
                known = _words(self._index[k] for k in dependencies[place])
                SubElement(lists[kind], "Unknown", index=str(self._index[place]), dependencies=known)
