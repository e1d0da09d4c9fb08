"""From the words of a command to a plan: preset or file, recording, options."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mapstream.graph.cli.output import say_aside
from mapstream.graph.fit import check_fit, propose_topics, readings_of
from mapstream.graph.load import Graph, load_graph, preset_names
from mapstream.graph.plan import Plan, plan
from mapstream.recordings.recording import open_recording


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """What the user asks for."""

    graph: str
    recording: Path | None = None
    params: dict[str, str] = field(default_factory=dict)
    sets: Sequence[str] = ()
    profile: str = "replay"
    needs_values: bool = True

    def load(self, sets: Sequence[str] = ()) -> Graph:
        params = dict(self.params)
        if self.recording is not None:
            params["recording"] = str(self.recording)
        return load_graph(
            self.graph,
            params=params,
            sets=[*sets, *self.sets],
            profile=self.profile,
            needs_values=self.needs_values,
        )


@dataclass(frozen=True, slots=True)
class Planned:
    """A plan, and what was found out about the recording on the way."""

    plan: Plan
    notes: list[str]


def plan_request(request: Request) -> Planned:
    """Load and plan a graph; with a recording, see that the two fit.

    A preset reads the one topic of the right type where its default is not there, and says so.

    Raises:
        ConfigError: If the graph or the options are wrong, or the recording lacks what the graph reads.
        RecordingError: If the recording cannot be opened.
    """
    graph = request.load()
    planned = plan(graph)
    if request.recording is None or not readings_of(planned, request.recording):
        return Planned(planned, [])  # or its source checks it, as that of text files does
    with open_recording(request.recording) as recording:
        if request.graph in preset_names() and not _has_chosen_topics(request):
            sets, remarks = propose_topics(planned, recording)
            for remark in remarks:
                say_aside(remark)
            if sets:
                graph = request.load(sets)
                planned = plan(graph)
        return Planned(planned, check_fit(planned, graph.positions, recording))


def _has_chosen_topics(request: Request) -> bool:
    return any(name.endswith("_topic") for name in request.params) or any(
        ".topics." in option for option in request.sets
    )
