"""Learn the vocabulary that mapstream brings for MobileNetV2's maps: `python -m benchmarks.fit_vlad OUT`.

It is learnt from drawn rooms alone, none of which is a room of a test or a benchmark.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.operators.networks.embeddings import MobileNetCells
from mapstream.operators.networks.vlad import learn_vocabulary
from mapstream.recordings.worlds.simulation import Record
from mapstream.recordings.worlds.w_rgbd import WRgbdConfig, w_rgbd
from mapstream.recordings.worlds.w_vi import WViConfig, w_vi
from mapstream.streams.messages.sensors import EncodedImage

HALLS, ROOMS = range(1000, 1008), range(1000, 1004)
DIMENSIONS, NUM_WORDS = 48, 32
CAMERA = {"width_px": 320, "height_px": 240}


def images() -> Iterator[npt.NDArray[np.uint8]]:
    for seed in HALLS:
        hall = {"cameras": ["left", "rear"], "camera": CAMERA | {"rate_hz": 0.7}, "texel_m": 0.01}
        flight = {"flight": {"duration_s": 30.0}}
        yield from _colours(w_vi(WViConfig.model_validate(hall | flight), seed).records)
    for seed in ROOMS:
        room = {"duration_s": 20.0, "camera": CAMERA | {"rate_hz": 1.0}, "texel_m": 0.01}
        yield from _colours(w_rgbd(WRgbdConfig.model_validate(room), seed).records)


def _colours(records: Iterable[Record]) -> Iterator[npt.NDArray[np.uint8]]:
    for record in records:
        if isinstance(record.message, EncodedImage) and "depth" not in record.topic:
            image = cv2.imdecode(np.asarray(record.message.data), cv2.IMREAD_COLOR_RGB)
            yield np.asarray(image, np.uint8)


def main(out: Path) -> None:
    network = MobileNetCells(long_side_px=CAMERA["width_px"])
    cells = np.concatenate([network(image) for image in images()])
    learn_vocabulary(cells, DIMENSIONS, NUM_WORDS).save(out)
    print(f"{len(cells)} cells, {NUM_WORDS} words of {DIMENSIONS} numbers: {out}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
