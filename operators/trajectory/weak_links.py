"""Odometry only where vision is weak: where two poses see much in common, their landmarks say how they lie.

Source: Cramariuc et al., maplab 2.0, RA-L 2023; maplab's option `min_number_of_common_landmarks`.
"""

from __future__ import annotations

from collections.abc import Sequence

from mapstream.operators.submaps.overlap import Tracks
from mapstream.streams.messages.estimates import RelativePose

ALWAYS, NEVER = 0, -1


def without_superfluous(
    edges: Sequence[RelativePose], before: Tracks, now: Tracks, num_common: int
) -> list[RelativePose]:
    """Return the edges of an interval less odometry, if that many tracks are seen at both its ends.

    Where nothing else would join the two poses, odometry stays: a mission does not fall apart.

    Args:
        edges: Of all sources, over one interval.
        before: What is seen at its start.
        now: And at its end.
        num_common: Odometry stays below; `ALWAYS` and `NEVER` say so.
    """
    is_strong = num_common == NEVER or len(before & now) >= num_common
    others = [edge for edge in edges if edge.kind != "odometry"]
    if num_common == ALWAYS or not is_strong or not others:
        return list(edges)
    return others
