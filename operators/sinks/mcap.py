"""The end of a stream: an MCAP file."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, PositiveInt, field_validator

from mapstream.operators.operator import (
    DynamicPorts,
    NoPorts,
    Operator,
    OperatorConfig,
    Ports,
    offload,
    report_loss,
    report_written,
)
from mapstream.operators.sources.mcap_config import check_message_name, type_of_port
from mapstream.recordings.foxglove_messages import as_foxglove
from mapstream.recordings.mcap_writer import Compression, McapWriter
from mapstream.streams.messages.sensors import Message
from mapstream.streams.sync import merge


class WrittenTopicConfig(OperatorConfig):
    topic: str
    type: str | None = Field(
        default=None, description="the message, where the port's name does not say: Submap, ..."
    )

    _check_type = field_validator("type")(check_message_name)


class McapSinkConfig(OperatorConfig):
    path: Path = Field(default=Path("out.mcap"), description="the file, replaced if it exists")
    topics: dict[str, str | WrittenTopicConfig] = Field(
        description="port: topic, or port: {topic, type}"
    )
    schemas: Literal["mapstream", "foxglove", "both"] = Field(
        default="both",
        description="ours hold everything; Foxglove's, under /foxglove, are for its viewer",
    )
    compression: Compression = "zstd"
    chunk_bytes: PositiveInt = 1 << 20

    @field_validator("topics")
    @classmethod
    def _check_topics(
        cls, topics: dict[str, str | WrittenTopicConfig]
    ) -> dict[str, str | WrittenTopicConfig]:
        if not topics:
            raise ValueError("no topics; give at least one, such as {odometry: /odometry}")
        return topics

    def topic(self, port: str) -> WrittenTopicConfig:
        """Return what a port writes, in full."""
        entry = self.topics[port]
        return WrittenTopicConfig(topic=entry) if isinstance(entry, str) else entry


class McapSink(DynamicPorts, Operator[Ports, NoPorts]):
    """Write what comes to an MCAP file, in the order of stamps.

    The order does not depend on which input is faster, so the same streams give the same file.
    """

    placement = "thread"
    spans_epochs = True

    def __init__(self, config: McapSinkConfig) -> None:
        self.config = config

    @classmethod
    def ports_for(cls, config: McapSinkConfig) -> tuple[dict[str, Any], dict[str, Any]]:
        return {port: type_of_port(port, config.topic(port).type) for port in config.topics}, {}

    async def run(self, inputs: Ports, outputs: NoPorts) -> None:  # noqa: ARG002
        config = self.config
        topics = [config.topic(port).topic for port in inputs]
        with McapWriter(
            config.path, compression=config.compression, chunk_bytes=config.chunk_bytes
        ) as writer:
            messages = merge(*inputs.values())
            async for port, message in messages:
                await offload(self.write, writer, topics[port], message)
        report_written(config.path)
        for port_name, count in messages.stats.late.items():
            for _ in range(count):
                report_loss(f"messages on {port_name} behind their time bound")

    def write(self, writer: McapWriter, topic: str, message: Message) -> None:
        """Write one message in the schemas that were chosen.

        Raises:
            RecordingError: If the disk is full.
        """
        if self.config.schemas != "foxglove":
            writer.write(topic, message)
        if self.config.schemas != "mapstream":
            for channel, data in as_foxglove(f"/foxglove{topic}", message):
                writer.write_raw(channel, data, message.stamp_ns)
