"""Graph files are read to the letter, and every mistake is told with its place."""

from __future__ import annotations

import textwrap
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.graph.document import read_document, read_scalar
from mapstream.graph.load import Graph, load_graph, parse_graph
from mapstream.graph.problems import GraphError
from mapstream.streams.errors import ConfigError

GRAPH = """\
version: 1
name: small
params:
  recording: {type: path}
  voxel_size_m: {type: float, default: 0.5, min: 0.05, unit: m}
operators:
  sensors: {use: mcap, config: {path: $recording, topics: {scans: /points}}}
  odometry:
    use: kiss_odometry
    in: {scans: sensors.scans}
    config: {voxel_size_m: $voxel_size_m, label: "v${voxel_size_m}$$"}
    run: process
"""


def load(text: str, **options: object) -> Graph:
    options.setdefault("params", {"recording": "a.mcap"})
    return parse_graph(textwrap.dedent(text), **options)  # type: ignore[arg-type]  # as given


def refusal(text: str, **options: object) -> str:
    with pytest.raises(GraphError) as caught:
        load(text, **options)
    return str(caught.value)


def test_reads_edges_config_and_placement() -> None:
    odometry = load(GRAPH).spec.operators["odometry"]

    assert odometry.in_["scans"].from_ == "sensors.scans"
    assert odometry.run.where == "process"


def test_parameters_keep_their_type_and_fill_strings() -> None:
    config = load(GRAPH).spec.operators["odometry"].config

    assert config == {"voxel_size_m": 0.5, "label": "v0.5$"}


def test_parameter_from_the_command_line_is_typed() -> None:
    graph = load(GRAPH, params={"recording": "1e3", "voxel_size_m": "1e-1"})

    assert graph.spec.operators["sensors"].config["path"] == "1e3"
    assert graph.spec.operators["odometry"].config["voxel_size_m"] == 0.1


def test_parameter_from_its_environment_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VOXEL", "0.25")

    graph = load(GRAPH.replace("unit: m", "env: VOXEL"))

    assert graph.spec.operators["odometry"].config["voxel_size_m"] == 0.25


def test_recording_and_map_need_no_declaration() -> None:
    text = GRAPH.replace("  recording: {type: path}\n", "")

    graph = load(text, params={"recording": "b.mcap"})

    assert graph.spec.operators["sensors"].config["path"] == "b.mcap"


def test_stand_ins_for_missing_values_let_one_look_at_a_preset_like_graph(tmp_path: Path) -> None:
    file = tmp_path / "small.yaml"
    file.write_text(GRAPH)

    graph = load_graph(file, needs_values=False)

    assert graph.spec.operators["sensors"].config["path"] == "<recording>"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("use: kiss", "yse: kiss", "graph.yaml:8:3: operators.odometry.use: is missing"),
        (
            "use: kiss",
            "yse: kiss",
            "graph.yaml:9:5: operators.odometry.yse: unknown key; did you mean 'use'?",
        ),
        ("run: process", "run: proces", "graph.yaml:12:5: operators.odometry.run: should be"),
        ("version: 1", "version: 2", "graph.yaml:1:1: version: should be 1, found 2"),
        (
            "run: process",
            "run: {where: thread, workers: 0}",
            "12:26: operators.odometry.run.workers: should be greater than 0, found 0",
        ),
        (
            "{scans: sensors.scans}",
            "{scans: {from: sensors.scans, polycy: latest}}",
            "10:39: operators.odometry.in.scans.polycy: unknown key; did you mean 'policy'?",
        ),
        (
            "{scans: sensors.scans}",
            "{scans: sensors}",
            "10:10: operators.odometry.in.scans: String should match pattern",
        ),
        ("$recording,", "$recordin,", "no parameter 'recordin'; did you mean 'recording'?"),
        ("${voxel_size_m}", "${voxel_size}", "11:43: operators.odometry.config.label: no param"),
        ("type: float", "type: flaot", "graph.yaml:5:18: params.voxel_size_m.type: should be"),
        ("default: 0.5", "default: 0.01", "expected at least 0.05 m, found 0.01"),
        ("default: 0.5", "default: big", "5:3: params.voxel_size_m: parameter 'voxel_size_m': e"),
        ("default: 0.5", "default: .nan", "expected float, found .nan"),
        (
            "{scans: sensors.scans}",
            "{scans: {from: sensors.scans, max_age_s: .inf}}",
            "operators.odometry.in.scans.max_age_s: should be a finite number, found .inf",
        ),
        ("type: path", "type: path, min: 3", "min and max are for int and float, not path"),
        ("run: process", "use: other", "12:5: operators.odometry.use: twice in one map, first in"),
        ("run: process", "run: !!python/name:os.system x", "12:10: operators.odometry.run: tag"),
        ("run: process", "1: process", "graph.yaml:12:5: operators.odometry: a key must be text"),
        ("run: process", "run: [process", "graph.yaml:13:1: not YAML: expected ','"),
        ("run: process", "file: x.yaml", "8:3: operators.odometry: `file` and `with` are for"),
        ("operators:", "operator:", "graph.yaml:6:1: operator: unknown key; did you mean 'opera"),
    ],
)
def test_B17_refusal_names_line_key_and_reason(old: str, new: str, message: str) -> None:
    assert message in refusal(GRAPH.replace(old, new, 1))


def test_all_problems_are_told_at_once() -> None:
    text = GRAPH.replace("run: process", "rum: process").replace("use: mcap", "usw: mcap")

    assert len(refusal(text).splitlines()) == 3  # usw, use, rum


def test_missing_value_and_mistake_are_told_together() -> None:
    message = refusal(GRAPH.replace("run: process", "rum: process"), params={})

    assert "params.recording: no value" in message
    assert "operators.odometry.rum: unknown key" in message


def test_unknown_parameter_is_one_problem_though_its_key_wants_another_type() -> None:
    message = refusal(GRAPH.replace("run: process", "enabled: $on"))

    (problem,) = message.splitlines()
    assert problem.startswith("graph.yaml:12:5: operators.odometry.enabled: no parameter 'on'")


def test_missing_value_says_how_to_give_it() -> None:
    assert "params.recording: no value; give RECORDING after the graph" in refusal(GRAPH, params={})


def test_value_for_no_parameter() -> None:
    message = refusal(GRAPH, params={"recording": "x", "voxel": "1"})

    assert message == "--param voxel=1: no parameter 'voxel'; did you mean 'voxel_size_m'?"


def test_recording_for_a_graph_that_reads_none() -> None:
    text = GRAPH.replace("  recording: {type: path}\n", "").replace("$recording", "a.mcap")

    assert refusal(text) == "RECORDING a.mcap: no parameter 'recording'; there is voxel_size_m"


def test_file_that_is_no_map() -> None:
    assert "expected keys and values" in refusal("- a\n- b\n")


def test_tower_of_aliases_is_refused() -> None:
    rows = [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 9)]

    assert "not a graph" in refusal("\n".join(["a0: &a0 [x]", *rows]))


def test_yaml_1_2_scalars() -> None:
    data = read_document("on: no\nt: 12:30:00\nf: 1e-3\nd: 2020-01-01\ni: 0123", "x").data

    assert data == {"on": "no", "t": "12:30:00", "f": 0.001, "d": "2020-01-01", "i": 123}


@given(
    st.one_of(st.integers(), st.booleans(), st.floats(allow_nan=False), st.text("abc", min_size=1))
)
def test_scalars_round_trip(value: object) -> None:
    """What YAML would write for a value is read as that value, with its type."""
    text = str(value).lower() if isinstance(value, bool) else str(value).replace("inf", ".inf")

    read = read_scalar(text)

    assert read == value
    assert type(read) is type(value)


class TestSets:
    def test_B17_option_of_one_operator(self) -> None:
        graph = load(GRAPH, sets=["odometry.voxel_size_m=2", "odometry.run=thread"])

        assert graph.spec.operators["odometry"].config["voxel_size_m"] == 2
        assert graph.spec.operators["odometry"].run.where == "thread"

    def test_path_into_maps_and_inputs(self) -> None:
        graph = load(GRAPH, sets=["sensors.topics.imu=/imu", "odometry.in.scans.policy=latest"])

        assert graph.spec.operators["sensors"].config["topics"]["imu"] == "/imu"
        assert graph.spec.operators["odometry"].in_["scans"].policy == "latest"

    @pytest.mark.parametrize(
        ("option", "message"),
        [
            ("odometri.x=1", "no operator 'odometri'; did you mean 'odometry'?"),
            ("odometry=1", "expected OPERATOR.KEY=VALUE"),
            ("odometry.run=thred", "operators.odometry.run: should be 'inline'"),
            ("odometry.voxel_size_m.x=1", "config.voxel_size_m holds no keys, so no 'x'"),
            ("odometry.x=[1", "cannot be read: not YAML"),
        ],
    )
    def test_refusal_quotes_the_option(self, option: str, message: str) -> None:
        text = refusal(GRAPH, sets=[option])

        assert text.startswith(f"--set {option}: ")
        assert message in text


class TestProfiles:
    def test_replay_blocks_and_live_drops_at_the_sources(self) -> None:
        assert load(GRAPH).profile.edges.policy == "block"
        assert load(GRAPH, profile="live").profile.sources.policy == "drop_oldest"

    def test_own_profile_over_the_built_in_one(self) -> None:
        text = GRAPH + "profiles: {live: {clock: {rate: 2.0}, edges: {capacity: 2}}}\n"

        profile = load(text, profile="live").profile

        assert (profile.clock.from_, profile.clock.rate, profile.edges.capacity) == ("wall", 2.0, 2)
        assert profile.sources.policy == "drop_oldest"

    def test_unknown_profile(self) -> None:
        with pytest.raises(
            ConfigError, match="--profile lve: no such profile; did you mean 'live'"
        ):
            load(GRAPH, profile="lve")


PART = """\
version: 1
name: part
inputs: [numbers]
outputs: {result: last.numbers}
params: {factor: {type: int, default: 2}}
operators:
  first: {use: double, in: {numbers: {from: inputs.numbers, capacity: 3}}, config: {factor: $factor}}
  last: {use: double, in: {numbers: first.numbers}}
"""
WHOLE = """\
version: 1
name: whole
operators:
  source: {use: count}
  part: {use: graph, file: part.yaml, in: {numbers: source.numbers}, with: {factor: 5}}
  sink: {use: collect, in: {numbers: part.result}}
"""


class TestSubgraphs:
    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        (tmp_path / "part.yaml").write_text(PART)
        return tmp_path

    def load(self, folder: Path, text: str = WHOLE, **options: object) -> Graph:
        (folder / "whole.yaml").write_text(text)
        return load_graph(folder / "whole.yaml", **options)  # type: ignore[arg-type]  # as given

    def test_B17_expands_to_names_inside(self, folder: Path) -> None:
        operators = self.load(folder).spec.operators

        assert list(operators) == ["source", "part/first", "part/last", "sink"]
        assert operators["part/first"].in_["numbers"].from_ == "source.numbers"
        assert operators["part/first"].in_["numbers"].capacity == 3
        assert operators["part/last"].in_["numbers"].from_ == "part/first.numbers"
        assert operators["sink"].in_["numbers"].from_ == "part/last.numbers"
        assert operators["part/first"].config == {"factor": 5}

    def test_parts_in_parts(self, folder: Path) -> None:
        middle = PART.replace("name: part", "name: middle").replace(
            "last: {use: double,", "last: {use: graph, file: part.yaml,"
        )
        (folder / "middle.yaml").write_text(middle.replace("last.numbers", "last.result"))

        operators = self.load(folder, WHOLE.replace("part.yaml", "middle.yaml")).spec.operators

        assert operators["sink"].in_["numbers"].from_ == "part/last/last.numbers"
        assert operators["part/last/first"].in_["numbers"].from_ == "part/first.numbers"

    def test_set_reaches_inside(self, folder: Path) -> None:
        graph = self.load(folder, sets=["part/first.factor=7"])

        assert graph.spec.operators["part/first"].config["factor"] == 7

    def test_disabled_as_a_whole(self, folder: Path) -> None:
        operators = self.load(
            folder, WHOLE.replace("with:", "enabled: false, with:")
        ).spec.operators

        assert not operators["part/first"].enabled

    def test_places_are_those_of_the_part(self, folder: Path) -> None:
        positions = self.load(folder).positions

        assert str(positions.of(("operators", "part/last", "use"))).endswith("part.yaml:8:10")

    @pytest.mark.parametrize(
        ("old", "new", "message"),
        [
            ("in: {numbers: s", "in: {nombers: s", "part.yaml has no input 'nombers'; did you mea"),
            ("part.result", "part.rsult", "6:29: operators.sink.in.numbers: the graph 'part' has"),
            ("part.yaml", "prt.yaml", "whole.yaml:5:22: operators.part.file: there is no file"),
            ("part.yaml", "whole.yaml", "may not contain itself: whole.yaml -> whole.yaml"),
            ("factor: 5", "facter: 5", "no parameter 'facter'; did you mean 'factor'?"),
            ("factor: 5", "factor: x", "parameter 'factor': expected int, found 'x'"),
            ("file: part.yaml, ", "", "`use: graph` needs `file:`"),
            ("with:", "config:", "are for operators; a sub-graph takes `with:`"),
        ],
    )
    def test_refusal(self, folder: Path, old: str, new: str, message: str) -> None:
        with pytest.raises(GraphError) as caught:
            self.load(folder, WHOLE.replace(old, new, 1))

        assert message in str(caught.value)

    def test_a_part_alone_does_not_run(self, folder: Path) -> None:
        with pytest.raises(GraphError, match=r"part\.yaml:3:1: is a part of other graphs"):
            load_graph(folder / "part.yaml")


def test_preset_that_is_not_there() -> None:
    with pytest.raises(ConfigError, match="no graph file and no preset 'lidr'"):
        load_graph("lidr")


def test_file_that_is_not_there() -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: cannot be read: .*No such file"):
        load_graph("nowhere.yaml")
