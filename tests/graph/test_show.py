"""A graph can be drawn before it runs."""

from __future__ import annotations

import re

from mapstream.graph.catalogue import Catalogue
from mapstream.graph.load import parse_graph
from mapstream.graph.plan import Plan, plan
from mapstream.graph.show import mermaid, text
from tests.graph.stages import STAGES

GRAPH = """\
version: 1
name: sums
operators:
  source: {use: count}
  twice: {use: double, in: {numbers: source.numbers}, run: {where: thread, workers: 2}}
  again: {use: double, in: {numbers: {from: twice.numbers, policy: latest}}}
  sink: {use: collect, in: {numbers: twice.numbers}}
"""


def planned() -> Plan:
    return plan(parse_graph(GRAPH), Catalogue(STAGES))


def test_B17_mermaid_has_every_operator_and_edge() -> None:
    drawn = mermaid(planned())

    assert drawn.startswith("flowchart LR\n")
    assert len(re.findall(r"^  n\d+[(\[]", drawn, re.MULTILINE)) == 4
    assert drawn.count("-->") == 3
    assert '|"numbers<br/>Number, latest"|' in drawn


def test_mermaid_tells_sources_sinks_and_placement() -> None:
    drawn = mermaid(planned())

    assert '(["source<br/><i>count</i>"]):::inline' in drawn
    assert '[["sink<br/><i>collect</i>"]]:::inline' in drawn
    assert '["twice<br/><i>double</i>"]:::thread' in drawn


def test_text_says_what_goes_where() -> None:
    assert text(planned()).splitlines() == [
        "sums: 4 operators, 3 edges, profile replay",
        "source  (count, inline)",
        "  numbers: Number -> twice.numbers",
        "twice  (double, thread x 2)",
        "  numbers: Number -> again.numbers, latest",
        "  numbers: Number -> sink.numbers",
        "again  (double, thread)",
        "  numbers: Number (not connected)",
        "sink  (collect, inline)",
    ]
