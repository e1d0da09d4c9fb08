"""Our graphs give what the authors' code gives with the same weights (reference/make.py)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from mapstream.operators.networks.lightglue_network import lighterglue_model
from mapstream.operators.networks.mobilenet_network import embedding_model, feature_map_model
from mapstream.operators.networks.sessions import Session
from mapstream.operators.networks.xfeat_network import xfeat_model
from tests.operators.networks.pictures import picture
from tests.operators.networks.weights import installed

Outputs = dict[str, npt.NDArray[Any]]


@pytest.fixture(scope="session")
def reference() -> Outputs:
    with np.load(Path(__file__).parent / "reference" / "outputs.npz") as archive:
        return dict(archive)


def test_D11_xfeat_has_the_reference_keypoints(reference: Outputs) -> None:
    (weights,) = installed("xfeat")
    session = Session(xfeat_model(weights), "xfeat")
    for i, image in enumerate((picture(7), picture(7, (9, -5)))):
        count = len(reference[f"keypoints{i}"])

        found = session.run({"image": image[None, None], "top_k": np.array([count])})

        order, expected = (
            np.lexsort(k.T) for k in (found["keypoints"], reference[f"keypoints{i}"])
        )  # equal scores have no order
        for name, tolerance in (("keypoints", 1e-3), ("scores", 1e-4), ("descriptors", 1e-4)):
            np.testing.assert_allclose(
                found[name][order], reference[f"{name}{i}"][expected], atol=tolerance
            )


def test_D12_lighterglue_has_the_reference_matches(reference: Outputs) -> None:
    (weights,) = installed("lighterglue")
    session = Session(lighterglue_model(weights), "lighterglue")
    half = np.array([192, 128]) / 2
    feeds = {}
    for i in (0, 1):
        feeds[f"kpts{i}"] = ((reference[f"keypoints{i}"] - half) / half.max())[None]
        feeds[f"desc{i}"] = reference[f"descriptors{i}"][None]

    found = session.run(feeds)

    sure = np.where(found["mscores0"] > 0.1, found["matches0"], -1)
    np.testing.assert_array_equal(sure, reference["matches0"])
    np.testing.assert_allclose(found["mscores0"], reference["mscores0"], atol=1e-3)


def test_H17_mobilenet_has_the_reference_vectors(reference: Outputs) -> None:
    (weights,) = installed("mobilenet_v2")
    image = np.repeat(picture(7)[None, None], 3, axis=1)

    vector = Session(embedding_model(weights), "mobilenet_v2").run({"image": image})["embedding"]
    s16 = Session(feature_map_model(weights), "mobilenet_v2").run({"image": image})["s16"]

    np.testing.assert_allclose(vector[0], reference["embedding"], atol=1e-5)
    np.testing.assert_allclose(s16[0], reference["s16"], atol=1e-4)
