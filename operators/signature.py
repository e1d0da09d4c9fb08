"""What an operator's annotations say: its ports, their message types, its config. The only reflection."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, get_args, get_origin, get_type_hints

from mapstream.operators.operator import DynamicPorts, NoPorts, Operator, OperatorConfig, Ports
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Port:
    """One input or output; `is_optional` ones (annotated `Receiver[M] | None`) may stay unconnected."""

    name: str
    message_type: Any
    is_optional: bool = False


@dataclass(frozen=True, slots=True)
class Signature:
    """The outside of an operator."""

    operator_type: type[Operator[Any, Any]]
    config_type: type[OperatorConfig]
    inputs_type: type[Any]
    outputs_type: type[Any]
    inputs: dict[str, Port]
    outputs: dict[str, Port]
    takes_config: bool  # its `__init__` has a parameter `config`

    def make(self, config: OperatorConfig) -> Operator[Any, Any]:
        """Return a new operator."""
        arguments = {"config": config} if self.takes_config else {}
        return self.operator_type(**arguments)


def signature_of(
    operator_type: type[Operator[Any, Any]], config: OperatorConfig | None = None
) -> Signature:
    """Read the signature of an operator class.

    A class with `DynamicPorts` names its ports from its config; without one it has none.

    Raises:
        ConfigError: If the class does not say its ports or its config in the ways of `Operator`.
    """
    inputs_type, outputs_type = _ports_types(operator_type)
    hints = get_type_hints(operator_type.__init__)
    config_type = hints.get("config", OperatorConfig)
    if not (isinstance(config_type, type) and issubclass(config_type, OperatorConfig)):
        raise ConfigError(
            f"{operator_type.__name__}: `config` must be an OperatorConfig, not {config_type}"
        )
    inputs, outputs = _ports(inputs_type, Receiver), _ports(outputs_type, Sender)
    if config is not None and issubclass(operator_type, DynamicPorts):
        inputs_of, outputs_of = operator_type.ports_for(config)
        inputs |= {name: Port(name, message_type) for name, message_type in inputs_of.items()}
        outputs |= {name: Port(name, message_type) for name, message_type in outputs_of.items()}
    return Signature(
        operator_type=operator_type,
        config_type=config_type,
        inputs_type=inputs_type,
        outputs_type=outputs_type,
        inputs=inputs,
        outputs=outputs,
        takes_config="config" in hints,
    )


def _ports_types(operator_type: type) -> tuple[type, type]:
    for cls in operator_type.__mro__:
        for base in getattr(cls, "__orig_bases__", ()):
            arguments = get_args(base)
            if get_origin(base) is Operator and len(arguments) == 2:
                return arguments[0], arguments[1]
    raise ConfigError(f"{operator_type.__name__}: not declared as Operator[Inputs, Outputs]")


def _ports(ports_type: type, end: type) -> dict[str, Port]:
    if ports_type is NoPorts or ports_type is Ports:
        return {}
    hints = get_type_hints(ports_type)
    ports = {}
    for field in fields(ports_type):
        options = [a for a in (get_args(hints[field.name]) or ()) if get_origin(a) is end]
        annotation = options[0] if options else hints[field.name]
        if get_origin(annotation) is not end:
            expected = f"{end.__name__}[Message]"
            raise ConfigError(
                f"{ports_type.__name__}.{field.name}: expected {expected}, got {annotation}"
            )
        ports[field.name] = Port(field.name, get_args(annotation)[0], is_optional=bool(options))
    return ports
