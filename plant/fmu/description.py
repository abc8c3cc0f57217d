"""modelDescription.xml of an exported plant, for FMI 2.0 and 3.0, from its variable table; and buildDescription.xml.

FMI 3.0 has arrays: one variable per entry of the table, whose value reference is its index in `exposed`. FMI 2.0 has
scalars: one per element, named `leg_length[1]` or `base_joints[1,3]`, counted from 1 and row by row, whose value reference
is its place in the vector of all values (`Layout`).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from xml.sax.saxutils import quoteattr

from plant.dynamics.variables import BRAKE, DRIVE_MODES, Variable, VariableTable
from plant.fmu.importer import element_names
from plant.pose import Array

QUANTITIES: dict[str, tuple[str, dict[str, int | str]]] = {
    "m": ("Length", {"m": 1}),
    "m/s": ("Velocity", {"m": 1, "s": -1}),
    "m/s2": ("Acceleration", {"m": 1, "s": -2}),
    "rad": ("Angle", {"rad": 1}),
    "rad/s": ("AngularVelocity", {"rad": 1, "s": -1}),
    "rad/s2": ("AngularAcceleration", {"rad": 1, "s": -2}),
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
"""What each unit measures, and its exponents of the SI base units."""

_PER_SECOND = {"m": "m/s", "m/s": "m/s2", "rad": "rad/s", "rad/s": "rad/s2", "1": "1/s", "A": "A/s"}
"""The units of the states' derivatives."""


@dataclass(frozen=True)
class Layout:
    """Where the values of a plant lie in one vector: states, inputs, parameters, outputs, derivatives of the states."""

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
        """Where the values of each variable begin, by its name."""
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
        """The state that a variable is the derivative of, or None."""
        return self.table.states[self.rates.index(variable)] if variable in self.rates else None

    def places(self, variable: Variable) -> range:
        """Where the values of a variable are."""
        return range(self.offsets[variable.name], self.offsets[variable.name] + variable.size)


@dataclass(frozen=True)
class Dependencies:
    """What depends on what, by the places of their values.

    Attributes:
        running: the states and inputs that each output and each derivative depends on.
        initial: the parameters and inputs that each output, state and derivative depends on before the start.
    """

    running: Mapping[int, frozenset[int]]
    initial: Mapping[int, frozenset[int]]


def start_of(variable: Variable, starts: Mapping[str, Array]) -> list[float]:
    """The start values of a variable, row by row: the drives on their brakes, the inputs zero."""
    if variable.discrete:
        return [float(BRAKE)] * variable.size
    if variable.causality == "parameter":
        return [float(value) for value in starts[variable.name].reshape(-1)]
    return [0.0] * variable.size


def build_description(identifier: str, sources: list[str]) -> str:
    """How others can compile the FMU: sources/buildDescription.xml of FMI 3.0."""
    files = "".join(f'<SourceFile name="{name}"/>' for name in sources)
    return _document(
        '<fmiBuildDescription fmiVersion="3.0">',
        f'<BuildConfiguration modelIdentifier="{identifier}" description="any C99 compiler; without -ffast-math">',
        f'<SourceFileSet language="C99">{files}</SourceFileSet>',
        "</BuildConfiguration>",
        "</fmiBuildDescription>",
    )


def model_description(
    fmi: int,
    identifier: str,
    description: str,
    layout: Layout,
    starts: Mapping[str, Array],
    token: str,
    dependencies: Dependencies,
    sources: list[str],
) -> str:
    """The text of modelDescription.xml.

    Args:
        fmi: version of FMI, 2 or 3.
        identifier: name of model and binaries.
        description: one line about the model.
        layout: its variables.
        starts: values of all parameters by name.
        token: instantiation token, or GUID.
        dependencies: what depends on what.
        sources: names of the C files.
    """
    writer = (_Fmi3 if fmi == 3 else _Fmi2)(layout, starts, dependencies)
    head = (
        f"modelName={quoteattr(identifier)} description={quoteattr(description)}"
        ' generationTool="gough" variableNamingConvention="structured"'
    )
    return _document(*writer.document(head, identifier, token, sources))


def _document(*lines: str) -> str:
    return "\n".join(['<?xml version="1.0" encoding="UTF-8"?>', *lines, ""])


_CATEGORY = '<Category name="logStatusError" description="why a call was refused or failed"/>'
_EXPERIMENT = '<DefaultExperiment startTime="0" stopTime="10" stepSize="0.001"/>'
_ITEMS = "".join(f'<Item name="{name}" value="{value}"/>' for value, name in DRIVE_MODES.items())


class _Writer:
    """What both versions have in common."""

    def __init__(self, layout: Layout, starts: Mapping[str, Array], dependencies: Dependencies) -> None:
        self.layout, self.starts, self.dependencies = layout, starts, dependencies

    def units(self) -> str:
        """The definitions of all units in use."""
        used = sorted({variable.unit for variable in self.layout.exposed} | {"s"})
        bases = [(unit, "".join(f' {base}="{exponent}"' for base, exponent in QUANTITIES[unit][1].items())) for unit in used]
        return "".join(f'<Unit name="{unit}"><BaseUnit{base}/></Unit>' for unit, base in bases)

    def variability(self, variable: Variable) -> str:
        if variable.causality == "parameter":
            return "tunable" if variable.tunable else "fixed"
        return "discrete" if variable.discrete else "continuous"

    def causality(self, variable: Variable) -> str:
        return "local" if variable.causality == "state" else variable.causality

    def calculated(self, variable: Variable) -> bool:
        return variable.causality in ("state", "output")

    def attributes(self, variable: Variable) -> str:
        """Quantity, unit and range."""
        if variable.discrete:
            return f' min="{variable.minimum:d}" max="{variable.maximum:d}"'
        quantity = QUANTITIES[variable.unit][0]
        bounds = f' min="{variable.minimum!r}" max="{variable.maximum!r}" nominal="{variable.nominal!r}"'
        return f' quantity="{quantity}" unit="{variable.unit}"{bounds}'

    def start(self, variable: Variable) -> list[str]:
        """The start values as text; none for what is calculated."""
        if self.calculated(variable):
            return []
        values = start_of(variable, self.starts)
        return [str(int(value)) if variable.discrete else repr(value) for value in values]

    def unknowns(self) -> Iterator[tuple[str, Variable, Mapping[int, frozenset[int]]]]:
        """Kind, variable and dependencies of everything that is listed as unknown, in the order of the standard."""
        layout, dependencies = self.layout, self.dependencies
        for output in layout.table.outputs:
            yield "Output", output, dependencies.running
        for rate in layout.rates:
            yield "Derivative", rate, dependencies.running
        for variable in (*layout.table.outputs, *layout.table.states, *layout.rates):
            yield "InitialUnknown", variable, dependencies.initial


class _Fmi3(_Writer):
    def document(self, head: str, identifier: str, token: str, _: list[str]) -> list[str]:
        able = (
            f'modelIdentifier="{identifier}" canGetAndSetFMUState="true" canSerializeFMUState="true"'
            ' providesDirectionalDerivatives="true" providesAdjointDerivatives="true"'
        )
        return [
            f'<fmiModelDescription fmiVersion="3.0" instantiationToken="{token}" {head}>',
            f"<ModelExchange {able}/>",
            f'<CoSimulation {able} canHandleVariableCommunicationStepSize="true"/>',
            f"<UnitDefinitions>{self.units()}</UnitDefinitions>",
            f'<TypeDefinitions><EnumerationType name="DriveMode">{_ITEMS}</EnumerationType></TypeDefinitions>',
            f"<LogCategories>{_CATEGORY}</LogCategories>",
            _EXPERIMENT,
            "<ModelVariables>",
            f'<Float64 name="time" valueReference="{len(self.layout.exposed)}" causality="independent"'
            ' variability="continuous" quantity="Time" unit="s" description="simulation time"/>',
            *(self._variable(reference, variable) for reference, variable in enumerate(self.layout.exposed)),
            "</ModelVariables>",
            f"<ModelStructure>{''.join(self._unknowns())}</ModelStructure>",
            "</fmiModelDescription>",
        ]

    def _variable(self, reference: int, variable: Variable) -> str:
        tag = "Enumeration" if variable.discrete else "Float64"
        start = " ".join(self.start(variable))
        extra = f' start="{start}"' if start else ""
        if variable.discrete:
            extra += ' declaredType="DriveMode"'
        if self.calculated(variable):
            extra += ' initial="calculated"'
        if (state := self.layout.state_of(variable)) is not None:
            extra += f' derivative="{self.layout.exposed.index(state)}"'
        dimensions = "".join(f'<Dimension start="{n}"/>' for n in variable.shape)
        return (
            f'<{tag} name="{variable.name}" valueReference="{reference}" causality="{self.causality(variable)}"'
            f' variability="{self.variability(variable)}"{self.attributes(variable)}{extra}'
            f" description={quoteattr(variable.description)}>{dimensions}</{tag}>"
        )

    def _unknowns(self) -> Iterator[str]:
        references = {place: i for i, v in enumerate(self.layout.exposed) for place in self.layout.places(v)}
        for kind, variable, dependencies in self.unknowns():
            tag = "ContinuousStateDerivative" if kind == "Derivative" else kind
            known = sorted({references[k] for place in self.layout.places(variable) for k in dependencies[place]})
            reference = self.layout.exposed.index(variable)
            yield f'<{tag} valueReference="{reference}" dependencies="{" ".join(map(str, known))}"/>'


class _Fmi2(_Writer):
    def document(self, head: str, identifier: str, token: str, sources: list[str]) -> list[str]:
        files = "".join(f'<File name="{name}"/>' for name in sources)
        structure: dict[str, list[str]] = {"Outputs": [], "Derivatives": [], "InitialUnknowns": []}
        for kind, text in self._unknowns():
            structure[f"{kind}s"].append(text)
        return [
            f'<fmiModelDescription fmiVersion="2.0" guid="{token}" {head} numberOfEventIndicators="0">',
            f'<CoSimulation modelIdentifier="{identifier}" canHandleVariableCommunicationStepSize="true"'
            ' canNotUseMemoryManagementFunctions="true" canGetAndSetFMUstate="true" canSerializeFMUstate="true"'
            f' providesDirectionalDerivative="true"><SourceFiles>{files}</SourceFiles></CoSimulation>',
            f"<UnitDefinitions>{self.units()}</UnitDefinitions>",
            f"<LogCategories>{_CATEGORY}</LogCategories>",
            _EXPERIMENT,
            "<ModelVariables>",
            *(line for variable in self.layout.exposed for line in self._scalars(variable)),
            "</ModelVariables>",
            "<ModelStructure>",
            *(f"<{tag}>{''.join(texts)}</{tag}>" for tag, texts in structure.items()),
            "</ModelStructure>",
            "</fmiModelDescription>",
        ]

    @cached_property
    def _index(self) -> dict[int, int]:
        """The index of each scalar, from its place."""
        places = [place for variable in self.layout.exposed for place in self.layout.places(variable)]
        return {place: index for index, place in enumerate(places, start=1)}

    def _scalars(self, variable: Variable) -> Iterator[str]:
        # Not every importer can set an enumeration.
        tag = "Integer" if variable.discrete else "Real"
        starts = self.start(variable)
        initial = ' initial="calculated"' if self.calculated(variable) else ""
        for i, (name, place) in enumerate(
            zip(element_names(variable.name, variable.shape), self.layout.places(variable), strict=True)
        ):
            extra = f' start="{starts[i]}"' if starts else ""
            if (state := self.layout.state_of(variable)) is not None:
                extra += f' derivative="{self._index[self.layout.offsets[state.name] + i]}"'
            yield (
                f'<ScalarVariable name="{name}" valueReference="{place}" causality="{self.causality(variable)}"'
                f' variability="{self.variability(variable)}"{initial} description={quoteattr(variable.description)}>'
                f"<{tag}{self.attributes(variable)}{extra}/></ScalarVariable>"
            )

    def _unknowns(self) -> Iterator[tuple[str, str]]:
        for kind, variable, dependencies in self.unknowns():
            for place in self.layout.places(variable):
                known = " ".join(map(str, sorted(self._index[k] for k in dependencies[place])))
                yield kind, f'<Unknown index="{self._index[place]}" dependencies="{known}"/>'
