"""Planning finds what cannot work before anything is opened, and says where it is written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mapstream.graph.catalogue import BUILT_IN, Catalogue
from mapstream.graph.load import parse_graph
from mapstream.graph.plan import Plan, plan
from mapstream.graph.problems import GraphError
from mapstream.graph.wiring import accepts, type_name
from mapstream.streams.errors import ConfigError
from mapstream.streams.messages.sensors import Message
from tests.graph.stages import STAGES, Number, Word

GRAPH = """\
version: 1
name: sums
operators:
  source: {use: count, config: {limit: 5}}
  twice: {use: double, in: {numbers: source.numbers}}
  sink: {use: collect, in: {numbers: {from: twice.numbers, capacity: 2, max_age_s: 0.5}}}
"""


def planned(text: str = GRAPH, sets: tuple[str, ...] = (), profile: str = "replay") -> Plan:
    return plan(parse_graph(text, sets=sets, profile=profile), Catalogue(STAGES))


def refusal(text: str) -> str:
    with pytest.raises(GraphError) as caught:
        planned(text)
    return str(caught.value)


def test_nodes_come_in_the_order_of_the_flow() -> None:
    head, source, *rest = GRAPH.partition("  source")
    moved = head + "".join(reversed((source + "".join(rest)).splitlines(keepends=True)))

    assert list(planned(moved).nodes) == ["source", "twice", "sink"]


def test_edge_has_type_limits_and_name() -> None:
    edge = planned().edges[1]

    assert edge.name == "twice.numbers -> sink.numbers"
    assert edge.message_type is Number
    assert (edge.limits.capacity, edge.limits.max_age_ns) == (2, 500_000_000)


def test_placement_is_that_of_the_class_unless_the_file_says() -> None:
    assert planned().nodes["twice"].placement == "thread"
    assert planned(sets=("twice.run=process",)).nodes["twice"].placement == "process"


def test_limits_come_from_the_profile_where_the_input_says_nothing() -> None:
    text = GRAPH + "profiles: {tight: {edges: {capacity: 1}, sources: {policy: latest}}}\n"

    from_source, to_sink = planned(text, profile="tight").edges

    assert (from_source.limits.policy, from_source.limits.capacity) == ("latest", 1)
    assert (to_sink.limits.policy, to_sink.limits.capacity) == ("block", 2)


def test_dropping_in_a_replay_is_a_warning() -> None:
    warnings = planned(sets=("sink.in.numbers.policy=latest",)).warnings

    assert warnings == (
        "twice.numbers -> sink.numbers: the policy latest drops by speed; two runs may differ",
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("use: double", "use: dobule", "graph.yaml:5:11: operators.twice.use: no operator 'dobu"),
        ("use: double", "use: dobule", "did you mean 'double'?"),
        (
            "twice.numbers",
            "twice.nmbers",
            "6:29: operators.sink.in.numbers: twice (double) has no output 'nmbers'; did you mean",
        ),
        ("twice.numbers", "sink.x", "sink (collect) has no output 'x'; it is a sink"),
        ("from: twice", "from: twic", "no operator 'twic'; did you mean 'twice'?"),
        (
            "{numbers: {from",
            "{nmbers: {from",
            "6:29: operators.sink.in.nmbers: collect has no input 'nmbers'; did you mean",
        ),
        ("config: {limit: 5}", "in: {x: sink.x}", "count has no input 'x'; it is a source"),
        (
            "{numbers: {from",
            "{words: {from",
            "twice.numbers sends Number, but sink.words takes Word",
        ),
        (
            ", in: {numbers: source.numbers}",
            "",
            "5:3: operators.twice: input 'numbers' (Number) is not connected; source.numbers would",
        ),
        (
            "limit: 5",
            "limit: 0",
            "4:33: operators.source.config.limit: should be greater than 0, found 0",
        ),
        (
            "limit: 5",
            "limt: 5",
            "4:33: operators.source.config.limt: unknown key; did you mean 'limit'?",
        ),
        ("source.numbers}", "twice.numbers}", "5:29: operators.twice.in.numbers: a cycle: twice -"),
        (
            "config: {limit: 5}",
            "enabled: false",
            "5:29: operators.twice.in.numbers: 'source' is not enabled, and this input needs",
        ),
        (
            "config: {limit: 5}",
            "run: {where: process, workers: 2}",
            "4:46: operators.source.run.workers: workers are threads",
        ),
    ],
)
def test_B17_refusal_names_line_and_ports(old: str, new: str, message: str) -> None:
    assert message in refusal(GRAPH.replace(old, new, 1))


def test_all_problems_are_told_at_once() -> None:
    text = GRAPH.replace("limit: 5", "limit: 0").replace("use: double", "use: dubbel")

    assert len(refusal(text).splitlines()) == 2  # and none about the edges of what is missing


def test_sink_without_any_input() -> None:
    message = refusal(GRAPH + "  empty: {use: collect}\n")

    assert "7:3: operators.empty: connect at least one of the inputs numbers, words" in message


class TestCycles:
    LOOP = GRAPH + "  back: {use: double, in: {numbers: twice.numbers}}\n"

    def test_names_all_in_the_cycle(self) -> None:
        message = refusal(self.LOOP.replace("source.numbers", "back.numbers"))

        assert "a cycle: " in message
        assert "twice -> back" in message

    def test_feedback_may_close_it(self) -> None:
        text = self.LOOP.replace("source.numbers", "{from: back.numbers, feedback: true}")

        edges = planned(text).edges

        assert [edge.name for edge in edges if edge.is_feedback] == [
            "back.numbers -> twice.numbers"
        ]


class TestOptionalInputs:
    def test_of_an_operator_that_is_not_enabled_are_left_out(self) -> None:
        text = GRAPH.replace(
            "in: {numbers: source.numbers}", "in: {numbers: source.numbers, hints: w.words}"
        )

        edges = planned(text + "  w: {use: spell, enabled: false}\n").edges

        assert [edge.to_port for edge in edges] == ["numbers", "numbers"]


class TestDynamicPorts:
    GRAPH = GRAPH.replace(
        "use: count, config: {limit: 5}", "use: any_source, config: {ports: [a, numbers]}"
    )

    def test_ports_are_those_of_the_config(self) -> None:
        edge = planned(self.GRAPH).edges[0]

        assert edge.is_unchecked
        assert edge.message_type is Number

    def test_port_that_the_config_does_not_name(self) -> None:
        message = refusal(self.GRAPH.replace("[a, numbers]", "[a]"))

        assert "source (any_source) has no output 'numbers'; there is a" in message


class TestTypes:
    @pytest.mark.parametrize(
        ("expected", "sent", "is_accepted"),
        [
            (Number, Number, True),
            (Number, Word, False),
            (Number | Word, Word, True),
            (Number, Number | Word, False),
            (Number | Word, Number | Word, True),
            (Message, Word, True),
            (Any, Word, True),
            (Word, Any, True),
        ],
    )
    def test_accepts(self, expected: object, sent: object, *, is_accepted: bool) -> None:
        assert accepts(expected, sent) is is_accepted

    def test_names(self) -> None:
        assert type_name(Number | Word) == "Number | Word"


class TestCatalogue:
    @pytest.fixture
    def site(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        """A folder of packages, with one that offers three operators."""
        folder = tmp_path / "acme_stages-1.0.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-stages\nVersion: 1.0\n")
        (folder / "entry_points.txt").write_text(
            "[mapstream.operators]\n"
            "acme_count = tests.graph.stages:Count\n"
            "acme_absent = no_such_module:Thing\n"
            "acme_wrong = tests.graph.stages:Number\n"
        )
        monkeypatch.syspath_prepend(tmp_path)
        return tmp_path

    @pytest.mark.usefixtures("site")
    def test_Q1_finds_operators_of_other_packages(self) -> None:
        catalogue = Catalogue()

        assert "acme_count" in catalogue.names()
        assert catalogue.origin("acme_count") == "acme-stages"
        assert catalogue.get("acme_count") is STAGES["count"]

    @pytest.mark.usefixtures("site")
    @pytest.mark.parametrize(
        ("name", "reason"),
        [
            ("acme_absent", "'acme_absent' of acme-stages cannot be imported: ModuleNotFoundError"),
            ("acme_wrong", "is <class 'tests.graph.stages.Number'>, not an Operator class"),
            ("acme_cout", "no operator 'acme_cout'; did you mean 'acme_count'?"),
        ],
    )
    def test_broken_plugin_is_told_when_it_is_used(self, name: str, reason: str) -> None:
        with pytest.raises(ConfigError) as caught:
            Catalogue().get(name)

        assert reason in str(caught.value)

    @pytest.mark.parametrize("name", sorted(BUILT_IN))
    def test_built_in_operators_can_be_imported(self, name: str) -> None:
        assert Catalogue().get(name).__doc__
