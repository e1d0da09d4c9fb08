"""What a graph file may say. Edges are written at the consumer: `in: {scans: sensors.scans}`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    model_validator,
)

from mapstream.operators.operator import Placement
from mapstream.streams.channel import Limits, Policy

SUBGRAPH = "graph"  # `use: graph` stands for the operators of another file
ErrorAction = Literal["stop", "skip", "restart", "disable"]
NAME_PATTERN = r"^[A-Za-z][A-Za-z0-9_]*$"
Name = Annotated[str, Field(pattern=NAME_PATTERN)]


class Spec(BaseModel):
    """A part of a graph file: frozen, unknown keys refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ParamSpec(Spec):
    """A value that the user of a graph gives; without a default it is required."""

    type: Literal["path", "int", "float", "bool", "str"]
    default: Any = None
    min: float | None = None
    max: float | None = None
    unit: str | None = None
    env: str | None = None  # the environment variable that may hold the value
    help: str = ""

    @model_validator(mode="after")
    def _limits_need_numbers(self) -> ParamSpec:
        if self.type not in ("int", "float") and (self.min is not None or self.max is not None):
            raise ValueError(f"min and max are for int and float, not {self.type}")
        return self


class LimitsSpec(Spec):
    """How much an edge holds, and what happens when it is full; None: as the profile says."""

    policy: Policy | None = None
    capacity: PositiveInt | None = None  # messages
    max_bytes: PositiveInt | None = None
    max_age_s: PositiveFloat | None = None
    lateness_s: NonNegativeFloat | None = None  # how far behind the newest a message may come

    def over(self, defaults: LimitsSpec) -> LimitsSpec:
        """Return these limits, with those of `defaults` where this one is silent."""
        own = {key: getattr(self, key) for key in LimitsSpec.model_fields}
        return LimitsSpec(
            **{
                k: getattr(defaults, k) if own[k] is None else own[k]
                for k in LimitsSpec.model_fields
            }
        )

    def to_limits(self) -> Limits:
        plain = Limits()
        return Limits(
            policy=self.policy or plain.policy,
            capacity=self.capacity or plain.capacity,
            max_bytes=self.max_bytes,
            max_age_ns=None if self.max_age_s is None else round(self.max_age_s * 1e9),
            lateness_ns=round((self.lateness_s or 0.0) * 1e9),
        )


class InputSpec(LimitsSpec):
    """Where an input's messages come from; `sensors.scans` alone is short for `{from: sensors.scans}`."""

    from_: Annotated[
        str,
        Field(alias="from", pattern=r"^[A-Za-z][A-Za-z0-9_/]*\.[A-Za-z][A-Za-z0-9_]*$"),
    ]
    feedback: bool = False  # this edge may close a cycle


class RunSpec(Spec):
    """Where an operator works; None: where its class prefers. `thread` alone is short for `{where: thread}`."""

    where: Placement | None = None
    workers: PositiveInt = 1


class OnErrorSpec(Spec):
    """What happens when an operator raises; `skip` alone is short for `{do: skip}`.

    `skip` counts the error and goes on with the next message, `restart` does so with a new operator, `disable`
    ends this operator alone. After `max` errors the run stops.
    """

    do: ErrorAction = "stop"
    max: PositiveInt = 3
    backoff_s: NonNegativeFloat = 1.0  # before a restart; twice as long each time


def _long_on_error(value: object) -> object:
    return {"do": value} if isinstance(value, str) else value


def _long_input(value: object) -> object:
    return {"from": value} if isinstance(value, str) else value


def _long_run(value: object) -> object:
    return {"where": value} if isinstance(value, str) else value


class OperatorSpec(Spec):
    """One operator, or with `use: graph` the operators of the graph in `file`."""

    use: str
    in_: Annotated[
        dict[
            Name,
            Annotated[
                InputSpec, BeforeValidator(_long_input, json_schema_input_type=str | InputSpec)
            ],
        ],
        Field(alias="in"),
    ] = {}
    config: dict[str, Any] = {}
    run: Annotated[
        RunSpec, BeforeValidator(_long_run, json_schema_input_type=Placement | RunSpec)
    ] = RunSpec()
    on_error: Annotated[
        OnErrorSpec | None,
        BeforeValidator(_long_on_error, json_schema_input_type=ErrorAction | OnErrorSpec | None),
    ] = None
    enabled: bool = True
    file: Path | None = None  # of a sub-graph, relative to the file that names it
    with_: Annotated[dict[Name, Any], Field(alias="with")] = {}  # parameters of a sub-graph

    @model_validator(mode="after")
    def _keys_fit_the_kind(self) -> OperatorSpec:
        if self.use == SUBGRAPH:
            if self.file is None:
                raise ValueError("`use: graph` needs `file:`, the graph file to insert")
            wrong = {"config", "run", "on_error"} & self.model_fields_set
            if wrong:
                raise ValueError(f"{sorted(wrong)} are for operators; a sub-graph takes `with:`")
        elif {"file", "with_"} & self.model_fields_set:
            raise ValueError("`file` and `with` are for `use: graph`; operators take `config:`")
        return self


class ClockSpec(Spec):
    """Where event time comes from, and how fast it goes."""

    from_: Annotated[Literal["data", "wall"], Field(alias="from")] = "data"
    rate: Literal["max", "auto"] | PositiveFloat = (
        "max"  # times real time; `auto` follows the queues
    )


class ProfileSpec(Spec):
    """How a graph runs: its clock, and the limits of edges that say nothing themselves."""

    clock: ClockSpec = ClockSpec()
    edges: LimitsSpec = LimitsSpec(policy="block")
    sources: LimitsSpec = LimitsSpec()  # of the edges that leave a source, before `edges`


PROFILES = {
    "replay": ProfileSpec(),
    "live": ProfileSpec.model_validate(
        {"clock": {"from": "wall", "rate": 1.0}, "sources": {"policy": "drop_oldest"}}
    ),
}


class RerunSpec(Spec):
    """Which edges the viewer gets: patterns of `operator.port` of the sender, such as `sensors.*`."""

    edges: list[str] = ["*"]
    except_: Annotated[list[str], Field(alias="except")] = []


class LogSpec(Spec):
    """What is recorded of a run beside its results."""

    rerun: RerunSpec = RerunSpec()


class GraphSpec(Spec):
    """A graph file."""

    version: Literal[1]
    name: str
    help: str = ""  # a line for lists of presets
    params: dict[Name, ParamSpec] = {}
    profiles: dict[Name, ProfileSpec] = {}
    inputs: list[Name] = []  # of a sub-graph; its operators read them as `inputs.NAME`
    outputs: dict[Name, str] = {}  # of a sub-graph: name -> `operator.port`
    operators: Annotated[dict[str, OperatorSpec], Field(min_length=1)]
    log: LogSpec = LogSpec()
