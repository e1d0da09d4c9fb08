"""Running one operator on lists of messages, for tests of operators here and in other packages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mapstream.operators.operator import Context, Operator, OperatorConfig, set_context
from mapstream.operators.signature import signature_of
from mapstream.streams.channel import Channel, Limits, Receiver, Sender

_UNBOUNDED = Limits(capacity=2**62)


async def run_operator(
    operator: Operator[Any, Any],
    *,
    config: OperatorConfig | None = None,
    run_context: Context | None = None,
    **inputs: Sequence[Any],
) -> dict[str, list[Any]]:
    """Feed each input port its messages, run the operator to its end, return what each output sent.

    Optional ports that get no messages stay unconnected.

    `config` is needed only for an operator whose config names its ports.
    """
    signature = signature_of(type(operator), config)
    receivers: dict[str, Receiver[Any] | None] = {}
    for port, declared in signature.inputs.items():
        if declared.is_optional and port not in inputs:
            receivers[port] = None
            continue
        channel: Channel[Any] = Channel(port, _UNBOUNDED)
        for message in inputs.get(port, ()):
            await channel.put(message)
        channel.close()
        receivers[port] = Receiver(channel, spans_epochs=operator.spans_epochs)
    outputs: dict[str, Channel[Any]] = {p: Channel(p, _UNBOUNDED) for p in signature.outputs}
    set_context(run_context or Context(name=type(operator).__name__))
    await operator.run(
        signature.inputs_type(**receivers),
        signature.outputs_type(**{port: Sender([channel]) for port, channel in outputs.items()}),
    )
    sent: dict[str, list[Any]] = {}
    for port, channel in outputs.items():
        channel.close()
        sent[port] = [message async for message in Receiver(channel, spans_epochs=True)]
    return sent
