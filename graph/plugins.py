"""Whether operators of another package keep the promises that graphs and replays rely on.

Each is constructed with its defaults, fed a few small messages, and run twice on two different clocks:
the same messages must give the same results, with stamps that grow and come from the messages.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from importlib.metadata import entry_points
from typing import Any, Literal

import anyio
import anyio.lowlevel
import numpy as np
from pydantic import ValidationError

from mapstream.graph.catalogue import GROUP, Catalogue, OperatorType
from mapstream.graph.problems import did_you_mean
from mapstream.graph.wiring import type_name
from mapstream.operators.operator import Context, DynamicPorts, OperatorConfig
from mapstream.operators.samples import PERIOD_NS, START_NS, has_samples, samples
from mapstream.operators.signature import Signature, signature_of
from mapstream.operators.testing import run_operator
from mapstream.streams.errors import ConfigError

_PATIENCE_S = 20.0  # for five small messages
_NUM_SAMPLES = 5
_END_NS = START_NS + (_NUM_SAMPLES + 600) * PERIOD_NS  # a minute later no stamp has any business


@dataclass(frozen=True, slots=True)
class Finding:
    """What is wrong with an operator, or could not be looked at."""

    operator: str
    level: Literal["error", "note"]
    message: str


@dataclass(frozen=True, slots=True)
class _FixedClock:
    """A clock that stands; who sleeps on it wakes at once."""

    stamp_ns: int

    def now_ns(self) -> int:
        return self.stamp_ns

    async def sleep_until(self, stamp_ns: int) -> None:  # noqa: ARG002  # as Clock has it
        await anyio.lowlevel.checkpoint()


def operators_of(package: str) -> list[str]:
    """Return the names of the operators that an installed package offers.

    Raises:
        ConfigError: If it offers none.
    """
    points = entry_points(group=GROUP)
    owners = {_normal(p.dist.name if p.dist else p.value.split(".")[0]) for p in points}
    names = [
        point.name
        for point in points
        if _normal(package)
        in (_normal(point.dist.name) if point.dist else "", point.module.split(".")[0])
    ]
    if not names:
        hint = did_you_mean(_normal(package), owners)
        raise ConfigError(f"{package}: no installed package of this name offers operators{hint}")
    return names


def _normal(package: str) -> str:
    return package.lower().replace("-", "_").replace(".", "_")


async def check_operator(name: str, catalogue: Catalogue) -> list[Finding]:
    """Return what is wrong with one operator; nothing if it keeps all promises."""
    try:
        kind = catalogue.get(name)
        signature = signature_of(kind)
    except (ConfigError, TypeError, NameError) as error:  # of annotations that cannot be read
        return [Finding(name, "error", str(error))]
    findings = [Finding(name, "error", message) for message in _static(kind, signature)]
    try:
        config = signature.config_type()
    except ValidationError as error:
        missing = ", ".join(".".join(map(str, e["loc"])) for e in error.errors())
        note = f"not run: its config has no default for {missing}"
        return [*findings, Finding(name, "note", note)]
    unknown = [p for p in signature.inputs.values() if not has_samples(p.message_type)]
    if not signature.inputs or issubclass(kind, DynamicPorts) or unknown:
        what = ", ".join(f"{p.name} ({type_name(p.message_type)})" for p in unknown)
        reason = f"there are no samples for {what}" if what else "it has no inputs of its own"
        return [*findings, Finding(name, "note", f"not run: {reason}")]
    return findings + [Finding(name, "error", m) for m in await _dynamic(signature, config)]


def _static(kind: OperatorType, signature: Signature) -> Iterator[str]:
    """Look at the class alone."""
    if not (kind.__doc__ or "").strip():
        yield "has no docstring; its first line is what `mapstream operators` shows"
    if not signature.inputs and not signature.outputs and not issubclass(kind, DynamicPorts):
        yield "has neither inputs nor outputs"
    for port in (*signature.inputs.values(), *signature.outputs.values()):
        message = port.message_type
        if message is Any or not isinstance(message, type):
            continue
        if not hasattr(message, "stamp_ns") and "stamp_ns" not in _field_names(message):
            yield f"port {port.name!r}: {type_name(message)} has no stamp_ns, so it is no message"
        elif is_dataclass(message) and not _is_frozen(message):
            yield f"port {port.name!r}: {type_name(message)} must be frozen: receivers share it"


def _is_frozen(message: Any) -> bool:  # noqa: ANN401  # a dataclass
    return bool(message.__dataclass_params__.frozen)


def _field_names(message: type) -> set[str]:
    return {f.name for f in fields(message)} if is_dataclass(message) else set()


async def _dynamic(signature: Signature, config: OperatorConfig) -> list[str]:
    """Run the operator twice and look at what it sends."""
    runs: list[dict[str, list[Any]]] = []
    for clock in (_FixedClock(START_NS), _FixedClock(START_NS + 10**18)):
        ports = signature.inputs.values()
        inputs: dict[str, Any] = {p.name: samples(p.message_type, _NUM_SAMPLES) for p in ports}
        before = fingerprint(inputs)
        try:
            with anyio.fail_after(_PATIENCE_S):
                operator = _construct(signature, config)
                context = Context(name=signature.operator_type.__name__, clock=clock)
                runs.append(await run_operator(operator, run_context=context, **inputs))
        except TimeoutError:
            return [f"did not end within {_PATIENCE_S:g} s after its inputs had ended"]
        except Exception as error:  # noqa: BLE001  # whatever it raises is the finding
            return [f"failed on {_NUM_SAMPLES} small messages: {type(error).__name__}: {error}"]
        if fingerprint(inputs) != before:
            return ["changes the messages that it gets; other receivers share them"]
    found = []
    if fingerprint(runs[0]) != fingerprint(runs[1]):
        found.append("sends something else when it runs again: a replay would not repeat itself")
    for port, sent in runs[0].items():
        stamps = [message.stamp_ns for message in sent]
        if stamps != sorted(stamps):
            found.append(f"output {port!r}: stamps go backwards")
        elif stamps and not START_NS - PERIOD_NS <= min(stamps) <= max(stamps) <= _END_NS:
            found.append(f"output {port!r}: stamps are not those of the inputs; take event time")
    return found


def _construct(signature: Signature, config: OperatorConfig) -> Any:  # noqa: ANN401  # any operator
    kind: Any = signature.operator_type
    takes_config = signature.config_type is not OperatorConfig
    return kind(config) if takes_config else kind()


def fingerprint(value: object) -> str:
    """Return a digest of messages: equal only where every field and array element is."""
    digest = hashlib.blake2b(digest_size=16)
    for part in _parts(value):
        digest.update(part)
    return digest.hexdigest()


def _parts(value: Any) -> Iterable[bytes]:  # noqa: ANN401  # any message
    if isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif is_dataclass(value):
        yield type(value).__name__.encode()
        for field in fields(value):
            yield from _parts(getattr(value, field.name))
    elif isinstance(value, dict):
        for key, item in value.items():
            yield str(key).encode()
            yield from _parts(item)
    elif isinstance(value, (list, tuple)):
        yield f"{len(value)}".encode()
        for item in value:
            yield from _parts(item)
    elif hasattr(value, "matrix"):
        yield from _parts(value.matrix)
    elif isinstance(value, float) and math.isnan(value):
        yield b"nan"
    else:
        yield repr(value).encode()
