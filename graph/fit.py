"""Whether a recording has what a planned graph reads: topics, types, per-point time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from mapstream.graph.document import Positions
from mapstream.graph.plan import Plan
from mapstream.graph.problems import GraphError, Problem, did_you_mean
from mapstream.graph.wiring import accepts, type_name
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.recording import Recording, Topic
from mapstream.streams.errors import DecodeError
from mapstream.streams.messages.sensors import LidarScan

_NUM_LOOKED_AT = 3  # messages of each topic


@dataclass(frozen=True, slots=True)
class Reading:
    """One topic that a source of the graph reads."""

    node: str
    port: str
    topic: str
    expected: Any  # what the receivers of the port take


def readings_of(plan: Plan, recording: Path) -> list[Reading]:
    """Return which topics of a recording the sources of a plan read."""
    return [
        Reading(node.name, port, getattr(entry, "topic", entry), _expected(plan, node.name, port))
        for node in plan.nodes.values()
        if node.is_source and Path(getattr(node.config, "path", "")) == recording
        for port, entry in getattr(node.config, "topics", {}).items()
    ]


def _expected(plan: Plan, node: str, port: str) -> Any:  # noqa: ANN401  # a message type
    declared = plan.nodes[node].signature.outputs[port].message_type
    types = [e.message_type for e in plan.edges if (e.from_node, e.from_port) == (node, port)]
    return next((t for t in [declared, *types] if t is not Any), Any)


def topics_for(expected: Any, recording: Recording) -> list[Topic]:  # noqa: ANN401  # a message type
    """Return the topics whose messages decode to a type, those with the most messages first."""
    found = [t for t in recording.topics.values() if _reads_as(t, expected)]
    return sorted(found, key=lambda topic: (-topic.count, topic.name))


def _reads_as(topic: Topic, expected: Any) -> bool:  # noqa: ANN401  # a message type
    """Return whether a topic decodes to a type, by itself or on request."""
    wanted = expected if isinstance(expected, type) else None
    for kind in (None, wanted):
        try:
            if accepts(expected, decoder_for(topic.channel, kind).message_type):
                return True
        except DecodeError:
            continue
    return False


def check_fit(plan: Plan, positions: Positions, recording: Recording) -> list[str]:
    """Look at the first messages of each topic that the graph reads, and return what is worth knowing.

    Raises:
        GraphError: If a topic is missing, or its messages are not what the graph takes.
    """
    readings = readings_of(plan, recording.path)
    problems: list[Problem] = []
    notes: list[str] = []
    if not readings:
        notes.append(f"no operator of {plan.name} reads {recording.path}")
    for reading in readings:
        wrong = _mismatch(reading, recording)
        if wrong is None:
            notes += [f"{reading.topic}: {note}" for note in _describe(reading, recording)]
        else:
            path = ("operators", reading.node, "config", "topics", reading.port)
            problems.append(Problem(positions.of(path), path, wrong))
    if problems:
        raise GraphError(problems)
    return notes


def _mismatch(reading: Reading, recording: Recording) -> str | None:
    """Return why a topic cannot serve, or None if it can."""
    topic = recording.topics.get(reading.topic)
    if topic is None:
        there = [t.name for t in topics_for(reading.expected, recording)]
        hint = did_you_mean(reading.topic, there or recording.topics)
        return f"{recording.path} has no topic {reading.topic!r}{hint}"
    try:
        kind = decoder_for(topic.channel).message_type
    except DecodeError as error:
        return f"{recording.path}: {error}"
    if _reads_as(topic, reading.expected):
        return None
    wanted = type_name(reading.expected)
    return f"{recording.path}: {topic.name} is {topic.schema_name}, read as {type_name(kind)}, not {wanted}"


def _describe(reading: Reading, recording: Recording) -> Iterator[str]:
    topic = recording.topics[reading.topic]
    decode = decoder_for(topic.channel)
    yield f"{topic.count} messages, {topic.frequency:.4g} Hz, {type_name(decode.message_type)}"
    messages = []
    for raw in islice(recording.messages([topic.name]), _NUM_LOOKED_AT):
        try:
            messages.append(decode(raw))
        except DecodeError as error:
            yield str(error).removeprefix(f"{topic.name}: ")
    if any(isinstance(m, LidarScan) and m.offsets_ns is None for m in messages):
        yield "points carry no time, so scans cannot be deskewed"
    if any(message.stamp_ns <= 0 for message in messages):
        yield "stamps are not set; try `stamp: log`"


def propose_topics(plan: Plan, recording: Recording) -> tuple[list[str], list[str]]:
    """Return `--set` options that read existing topics in place of missing ones, and what to say of it.

    A topic is replaced where the recording has exactly one of that type.

    Raises:
        GraphError: If there is none, or a choice.
    """
    sets, remarks = [], []
    for reading in readings_of(plan, recording.path):
        if reading.topic in recording.topics:
            continue
        found: Sequence[Topic] = topics_for(reading.expected, recording)
        kind = type_name(reading.expected)
        if len(found) != 1:
            there = ", ".join(topic.name for topic in found or recording.topics.values())
            reason = (
                f"and several of type {kind}: {there}; choose with"
                f" --set {reading.node}.topics.{reading.port}=TOPIC"
                if found
                else f"and none of type {kind}; there is {there or 'no message at all'}"
            )
            raise _no_topic(reading, recording, reason)
        topic = found[0].name
        sets.append(f"{reading.node}.topics.{reading.port}={topic}")
        remarks.append(f"reading {topic} ({found[0].schema_name}); there is no {reading.topic}")
    return sets, remarks


def _no_topic(reading: Reading, recording: Recording, reason: str) -> GraphError:
    path = ("operators", reading.node, "config", "topics", reading.port)
    message = f"no topic {reading.topic!r}, {reason}"
    return GraphError([Problem(Positions(str(recording.path)).of(()), path, message)])
