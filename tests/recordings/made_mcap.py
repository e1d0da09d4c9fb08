"""Small MCAP files, written by the `mcap` package, for tests of the reader."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

TOPICS = ("/imu", "/points", "/image")


@dataclass(frozen=True)
class Note:
    """One message to write."""

    topic: int
    log_ns: int
    size: int = 40

    def data(self, sequence: int) -> bytes:
        return (sequence.to_bytes(4, "little") * (self.size // 4 + 1))[: self.size]


def write_mcap(
    path: Path,
    chunks: Iterable[Sequence[Note]],
    *,
    compression: CompressionType = CompressionType.ZSTD,
    **options: Any,  # noqa: ANN401  # of the package's writer
) -> Path:
    """Write chunks with exactly these messages, in this order."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 30, compression=compression, **options)
        writer.start(profile="test", library="test")
        schema = writer.register_schema(name="Note", encoding="text", data=b"note")
        ids = [writer.register_channel(t, "bytes", schema_id=schema) for t in TOPICS]
        sequence = 0
        for chunk in chunks:
            for note in chunk:
                writer.add_message(
                    ids[note.topic], note.log_ns, note.data(sequence), note.log_ns, sequence
                )
                sequence += 1
            writer.flush()  # type: ignore[no-untyped-call]  # the package has no types here
        writer.add_attachment(1, 2, "calibration.yaml", "text/yaml", b"camera: none")
        writer.finish()  # type: ignore[no-untyped-call]  # the package has no types here
    return path
