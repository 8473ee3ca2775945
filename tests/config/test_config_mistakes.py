"""Every mistake in an arm description is reported at its own line and column, all of them at once."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from ident_service.config.load import load_arm
from ident_service.errors import ConfigError, Problem, UsageError

GOOD = """\
format: ident-arm
version: 1
name: tiny
kinematics:
  dh:
    convention: standard
    joints:
      one: {a: 0.5}
      two: {a: 0.5, alpha: pi/2}
gravity: [0, 0, -9.81]
joints:
  one: {position: [-1, 1], velocity: 2, home: 0}
  two: {position: [-1, 1], velocity: 2, body: {mass: [1, 2], center_of_mass: {lower: [0, 0, 0], upper: [1, 1, 1]}}}
constraints: {total_mass: {upper: 27}}
control: {rate: 1000}
identification: {smoothing: {order: 3, filter_torque: false}}
motions:
  identification:
    kind: fourier
    base_frequency: 0.1
    periods: 2
    joints:
      one: {a: [0.1, 0.2], b: [0.1, 0.2], q0: 0}
      two: {a: [0.1, 0.2], b: [0.1, 0.2], q0: 0}
  validation: {kind: seeded, seed: 3}
prior: {m1: 1.0}
driver: {kind: simulated, torque_noise: [0.1, 0.2]}
"""


def problems_of(folder: Path, text: str | bytes, name: str = "arm.yaml") -> tuple[Problem, ...]:
    """What is wrong with a description."""
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(ConfigError) as caught:
        load_arm(path)
    assert str(caught.value) == "\n".join(str(problem) for problem in caught.value.problems)
    return caught.value.problems


def place_of(text: str, mark: str) -> tuple[int, int]:
    """Line and column, counted from 1, where `mark` first stands."""
    before = text[: text.index(mark)]
    return before.count("\n") + 1, len(before) - (before.rfind("\n") + 1) + 1


def spoiled(old: str, new: str) -> str:
    """The good description with one place changed."""
    assert GOOD.count(old) == 1
    return GOOD.replace(old, new)


def test_joints_of_other_names_are_told_beside_mistakes_of_their_own(tmp_path: Path) -> None:
    text = spoiled("  one: {position: [-1, 1], velocity: 2, home: 0}", "  won: {position: [-1, 1], velocity: -2}")
    velocity, joints = problems_of(tmp_path, text)
    assert velocity.message.startswith("joints.won.velocity: must be greater than 0")
    assert joints.message.startswith("joints: won, two are not those of kinematics.dh: one, two")
    assert (joints.line, joints.column) == place_of(text, "joints:\n  won")


def test_the_description_that_the_others_spoil_is_good(tmp_path: Path) -> None:
    path = tmp_path / "arm.yaml"
    path.write_text(GOOD)
    assert load_arm(path).name == "tiny"


@pytest.mark.parametrize(
    ("old", "new", "mark", "message"),
    [
        pytest.param("version: 1", "version: 1\ncolour: red", "colour", "unknown key 'colour'", id="unknown key"),
        pytest.param("two: {a: 0.5,", "two: {b: 0.5,", "b: 0.5", "unknown key 'b'", id="unknown key in a DH row"),
        pytest.param("seed: 3}", "seed: 3, use_all: 1}", "use_all", "unknown key", id="unknown key in a motion"),
        pytest.param(
            "kind: simulated,", "kind: simulated, tick: 1,", "tick", "unknown key", id="unknown key in a driver"
        ),
        pytest.param(
            "one: {position: [-1, 1]", "one: {position: [1, -1]", "position: [1", "not below", id="lower above upper"
        ),
        pytest.param("mass: [1, 2]", "mass: [2, 2]", "mass: [2", "not below", id="empty interval"),
        pytest.param(
            "upper: [1, 1, 1]",
            "upper: [1, 0, 1]",
            "center_of_mass",
            "y: lower bound 0",
            id="lower above upper in a box",
        ),
        pytest.param("kind: simulated", "kind: 5", "kind: 5", "must be text, not 5", id="number for a kind"),
        pytest.param(
            "driver: {kind: simulated,", "driver: {", "driver: {", "'kind' is missing", id="driver of no kind"
        ),
        pytest.param("control: {rate: 1000}", "control: fast", "control", "must be a mapping", id="text for a section"),
        pytest.param("gravity: [0, 0, -9.81]", "gravity: 9.81", "gravity", "must be a list", id="number for a vector"),
        pytest.param("-9.81]", "-9.81, 0]", "gravity", "at most 3", id="vector too long"),
        pytest.param("periods: 2", "periods: '2'", "periods", "a whole number is needed", id="text for a whole number"),
        pytest.param(
            "order: 3", "order: true", "order", "must be a whole number, not true", id="truth for a whole number"
        ),
        pytest.param(
            "periods: 2", "periods: 2.5", "periods", "must be a whole number, not 2.5", id="fraction for a whole number"
        ),
        pytest.param("rate: 1000", "rate: true", "rate", "must be a number [Hz], not true", id="truth for a number"),
        pytest.param("home: 0", "home: true", "home", "must be a number [rad or m], not true", id="truth for an angle"),
        pytest.param("home: 0", "home: north", "home", "not an angle: 'north'", id="word for an angle"),
        pytest.param("alpha: pi/2", "alpha: pi/0", "alpha", "divided by zero", id="angle divided by zero"),
        pytest.param("rate: 1000", "rate: 1e999", "rate", "finite number", id="infinite number"),
        pytest.param("rate: 1000", "rate: 1e9", "rate", "at most 10000 [Hz], not 1e+09", id="rate of no loop"),
        pytest.param(
            "prior: {m1: 1.0}",
            "prior: {m1: 1.0}\nrecording: {rate: 1e9}",
            "rate: 1e9",
            "at most 100000 [Hz], not 1e+09",
            id="rate of no recording",
        ),
        pytest.param("order: 3", "order: 9", "order", "at most 8, not 9", id="number too large"),
        pytest.param("name: tiny", "name: ../etc", "name", "is not a name", id="name that is a path"),
        pytest.param("version: 1", "version: 2", "version", "must be 1, not 2", id="version of the future"),
        pytest.param("version: 1\n", "", "format", "'version' is missing", id="missing key at the top"),
        pytest.param("convention: standard\n    ", "", "dh:", "'convention' is missing", id="missing key inside"),
        pytest.param(", q0: 0}\n      two", "}\n      two", "one: {a: [", "'q0' is missing", id="missing middle"),
        pytest.param("home: 0", "home: 1.5", "one: {position", "home 1.5 lies outside", id="home outside limits"),
        pytest.param("prior: {m1: 1.0}", "prior: no.json", "prior", "no such file", id="missing prior file"),
        pytest.param(
            "prior: {m1: 1.0}",
            "prior: {m1: much}",
            "m1: much",
            "prior.m1: must be a number, not 'much'",
            id="word for a parameter",
        ),
        pytest.param(
            "b: [0.1, 0.2], q0: 0}\n  v", "b: [0.1], q0: 0}\n  v", "two: {a: [", "2 sine but 1 cosine", id="a, b"
        ),
        pytest.param(
            "two: {a: [0.1, 0.2], b: [0.1, 0.2]",
            "two: {a: [0.1], b: [0.1]",
            "identification:\n    kind",
            "different numbers of harmonics",
            id="harmonics",
        ),
        pytest.param(
            "      two: {a: [0.1",
            "      six: {a: [0.1",
            "joints:\n      one: {a: [",
            "must be one, two",
            id="motion joints",
        ),
        pytest.param("[0.1, 0.2]}", "[0.1]}", "torque_noise", "1 values for 2 joints", id="wrong length per joint"),
        pytest.param("{rate: 1000}", "{rate: 1, rate: 2}", "rate: 2", "'rate' stands twice", id="duplicate key inside"),
        pytest.param("[0, 0, -9.81]", "&g [0, 0, -9.81]", "&g", "anchors and aliases", id="anchor"),
        pytest.param("upper: [1, 1, 1]", "upper: [1, *g, 1]", "*g", "anchors and aliases", id="alias"),
        pytest.param("rate: 1000", "<<: {rate: 1000}", "<<", "a key is a plain word", id="merge key"),
        pytest.param("{rate: 1000}", "{[1, 2]: 3}", "[1, 2]: 3", "a key is a plain word", id="list for a key"),
        pytest.param("rate: 1000", "rate: !!float 1000", "!!float", "tag", id="tag of YAML"),
        pytest.param("name: tiny", "name: !!python/name:os.system tiny", "!!python", "tag", id="tag of Python"),
        pytest.param("name: tiny", "name: !secret 'tiny'", "!secret", "tag", id="tag of a quoted text"),
        pytest.param("{rate: 1000}", "!ref {rate: 1000}", "!ref", "tag", id="tag of a mapping"),
        pytest.param("[0, 0, -9.81]", "!ref [0, 0, -9.81]", "!ref", "tag", id="tag of a list"),
        pytest.param("{rate: 1000}", "{rate: [1000}", "}\nidentification: {s", "expected", id="bracket left open"),
    ],
)
def test_one_mistake_is_reported_where_it_stands(tmp_path: Path, old: str, new: str, mark: str, message: str) -> None:
    text = spoiled(old, new)
    found = problems_of(tmp_path, text)
    assert {problem.path for problem in found} == {(tmp_path / "arm.yaml").resolve()}
    assert {(problem.line, problem.column) for problem in found} == {place_of(text, mark)}
    assert message in found[0].message


@pytest.mark.parametrize(
    ("smoothing", "named"),
    [
        ("regressor_cutoff: 5", "smoothing.regressor_cutoff"),
        ("decimate: 4", "smoothing.decimate"),
        ("filter_torque: true", "smoothing.filter_torque"),
        ("filter_torque: true, decimate: 2", "smoothing.decimate, smoothing.filter_torque"),
    ],
)
def test_a_period_beside_filters_that_it_replaces_is_refused(tmp_path: Path, smoothing: str, named: str) -> None:
    mark = "identification: {smoothing"
    text = GOOD.replace("{smoothing: {order: 3, filter_torque: false}}", f"{{smoothing: {{{smoothing}}}, period: 2.5}}")
    assert text != GOOD
    (problem,) = problems_of(tmp_path, text)
    assert problem.message.endswith(f"period averages instead of filtering; leave out {named}")
    assert (problem.line, problem.column) == place_of(text, mark)


def test_a_period_beside_what_it_does_not_touch_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "arm.yaml"
    path.write_text(
        GOOD.replace("filter_torque: false}}", "filter_torque: false, decimate: 1, cutoff: 5}, period: 2.5}")
    )
    assert load_arm(path).identification.period == 2.5


def test_all_mistakes_are_reported_at_once(tmp_path: Path) -> None:
    text = GOOD
    changes = (
        ("name: tiny", "nmae: tiny", "nmae"),
        ("alpha: pi/2", "alpha: upwards", "alpha"),
        ("one: {position: [-1, 1]", "one: {position: [1, -1]", "position: [1, -1]"),
        ("rate: 1000", "rate: '1000'", "rate"),
        ("order: 3", "ordr: 3", "ordr"),
        ("base_frequency: 0.1", "base_frequency: -0.1", "base_frequency"),
        ("prior: {m1: 1.0}", "prior: no.json", "prior"),
    )
    for old, new, _ in changes:
        text = text.replace(old, new)
    found = problems_of(tmp_path, text)
    missing_name = (1, 1)
    assert {(p.line, p.column) for p in found} == {place_of(text, mark) for *_, mark in changes} | {missing_name}
    assert len(found) == len(changes) + 1


def test_all_disagreements_are_reported_at_once(tmp_path: Path) -> None:
    text = GOOD.replace("  two: {position", "  six: {position").replace("[0.1, 0.2]}", "[0.1]}")
    found = problems_of(tmp_path, text)
    assert {(p.line, p.column) for p in found} == {place_of(text, "joints:\n  one"), place_of(text, "torque_noise")}


def test_all_faults_of_the_yaml_itself_are_reported_at_once(tmp_path: Path) -> None:
    text = "name: a\nname: b\n? [x]\n: 1\njoints:\n  one: {home: 1, home: 2}\n"
    found = problems_of(tmp_path, text)
    assert [(p.line, p.column) for p in found] == [(2, 1), (3, 3), (6, 18)]
    text = "name: &a x\ndriver: *a\nprior: !b {}\n"
    assert [(p.line, p.column) for p in problems_of(tmp_path, text)] == [(1, 7), (2, 9), (3, 8)]


def test_an_alias_bomb_is_refused_before_it_expands(tmp_path: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 30)]
    found = problems_of(tmp_path, "\n".join(lines))
    assert {problem.message for problem in found[:-1]} == {"anchors and aliases are refused; write the value out"}
    assert (len(found), found[-1].message) == (101, f"and {30 + 29 * 9 - 100} more mistakes")


@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [
        pytest.param("".join(f"k{number}: 1\n" for number in range(24_000)), id="unknown keys"),
        pytest.param("gravity: [" + "x, " * 80_000 + "]", id="long list"),
        pytest.param("constraints: {links: {" + "a: {b: 1}, " * 22_000 + "}}", id="same key"),
        pytest.param("? " * 130_000, id="keys in keys"),
        pytest.param(
            f"joints: {{{'a' * 100_000}: {{" + "".join(f"k{n}: 1, " for n in range(13_000)) + "}}", id="words"
        ),
    ],
)
def test_the_worst_files_of_the_largest_size_take_little_time_and_few_words(tmp_path: Path, text: str) -> None:
    assert 200_000 < len(text) <= 256 * 2**10
    began = time.process_time()
    found = problems_of(tmp_path, text)
    # 0.3 s; by the parser in Python, which this was, a minute a megabyte.
    assert time.process_time() - began < 6.0
    assert len(found) <= 101
    assert sum(len(problem.message) for problem in found) < 60_000


def test_deep_nesting_is_refused_where_it_becomes_too_deep(tmp_path: Path) -> None:
    found = problems_of(tmp_path, "joints: " + "[" * 500)
    assert [(p.line, p.column, p.message) for p in found] == [(1, 9 + 31, "nested deeper than 32 levels")]
    # Some versions of libyaml refuse this while they read ahead, at a place behind.
    (beyond,) = problems_of(tmp_path, "joints: " + "[" * 10_000)
    assert (beyond.line, beyond.message) == (1, "nested deeper than 32 levels")
    assert beyond.column >= 9 + 31


def test_a_mistake_in_a_list_is_reported_at_its_item(tmp_path: Path) -> None:
    text = GOOD.replace("constraints: {", "terms: [viscous,\n        friction]\nconstraints: {")
    (found,) = problems_of(tmp_path, text)
    assert (found.line, found.column) == place_of(text, "friction")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        pytest.param(b"name: \xff\xfe", "not UTF-8 text", id="not UTF-8"),
        pytest.param(b"", "a mapping of keys to values", id="empty"),
        pytest.param(b"- one\n- two\n", "a mapping of keys to values", id="list"),
        pytest.param(b"just words", "a mapping of keys to values", id="words"),
        pytest.param(b"a" * (256 * 2**10 + 1), "larger than 262144 bytes", id="too large"),
    ],
)
def test_a_file_that_is_no_description_is_refused_as_a_whole(tmp_path: Path, content: bytes, message: str) -> None:
    (found,) = problems_of(tmp_path, content)
    assert (found.line, found.column) == (1, 1)
    assert message in found.message


def test_several_documents_in_one_file_are_refused_where_the_second_begins(tmp_path: Path) -> None:
    text = GOOD + "---\nname: second\n"
    (found,) = problems_of(tmp_path, text)
    assert (found.line, found.column) == place_of(text, "---")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        pytest.param("{", "not a JSON object with names and values", id="torn"),
        pytest.param("[1, 2]", "not a JSON object with names and values", id="list"),
        pytest.param('{"names": ["m1"]}', "not a JSON object with names and values", id="no values"),
        pytest.param('{"names": ["m1"], "values": ["heavy"]}', "not a JSON object", id="word for a number"),
        pytest.param('{"names": ["m1", "m2"], "values": [1]}', "2 names but 1 values", id="lengths"),
        pytest.param('{"names": ["m1", "m1"], "values": [1, 2]}', "stands twice", id="name twice"),
        pytest.param('{"names": ["m1"], "values": [1' + "0" * 400 + "]}", "not a JSON object", id="beyond floats"),
        pytest.param("[" * 200_000, "not a JSON object", id="deep"),
    ],
)
def test_a_bad_prior_file_is_reported_at_the_key_that_names_it(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "prior.json").write_text(content)
    text = spoiled("prior: {m1: 1.0}", "prior: prior.json")
    found = problems_of(tmp_path, text)
    assert {(p.line, p.column) for p in found} == {place_of(text, "prior")}
    assert message in found[0].message


def test_a_named_file_that_is_not_text_is_reported_at_its_key(tmp_path: Path) -> None:
    (tmp_path / "prior.json").write_bytes(b"\xff\xfe")
    text = spoiled("prior: {m1: 1.0}", "prior: prior.json")
    (found,) = problems_of(tmp_path, text)
    assert (found.line, found.column) == place_of(text, "prior")
    assert "not UTF-8" in found.message


@pytest.mark.parametrize("extends", ["missing.yaml", "[base.yaml]", "5"])
def test_extending_what_is_no_file_is_reported_at_the_key(tmp_path: Path, extends: str) -> None:
    text = f"name: child\nextends: {extends}\n"
    (found,) = problems_of(tmp_path, text)
    assert (found.line, found.column) == (2, 1)


def test_files_that_extend_each_other_in_a_circle_are_refused(tmp_path: Path) -> None:
    (tmp_path / "b.yaml").write_text("extends: c.yaml\n")
    (tmp_path / "c.yaml").write_text("extends: arm.yaml\n")
    (found,) = problems_of(tmp_path, "extends: b.yaml\n")
    assert "arm.yaml -> b.yaml -> c.yaml -> arm.yaml" in found.message


def test_a_mistake_in_an_extended_file_is_reported_in_that_file(tmp_path: Path) -> None:
    base = spoiled("rate: 1000", "rate: never")
    (tmp_path / "base.yaml").write_text(base)
    child = "extends: base.yaml\njoints: {one: {velocity: -2}}\n"
    found = problems_of(tmp_path, child)
    places = {(p.path.name, p.line, p.column) for p in found}
    assert places == {("base.yaml", *place_of(base, "rate")), ("arm.yaml", *place_of(child, "velocity"))}


def test_problems_read_as_file_line_column(tmp_path: Path) -> None:
    (found,) = problems_of(tmp_path, spoiled("rate: 1000", "rate: -1"))
    assert str(found).startswith(f"{(tmp_path / 'arm.yaml').resolve()}:15:11: control.rate: ")


def test_an_arm_that_is_no_file_and_no_name_is_a_usage_error_that_lists_the_names() -> None:
    with pytest.raises(UsageError, match=r"'nonesuch'.*wam7"):
        load_arm("nonesuch")


def test_prior_files_hold_what_the_json_says(tmp_path: Path) -> None:
    (tmp_path / "prior.json").write_text(json.dumps({"names": ["m1", "m2"], "values": [1, 2.5], "what": "a note"}))
    (tmp_path / "arm.yaml").write_text(spoiled("prior: {m1: 1.0}", "prior: prior.json"))
    prior = load_arm(tmp_path / "arm.yaml").prior
    assert prior is not None
    assert dict(zip(prior.names, prior.values, strict=True)) == {"m1": 1.0, "m2": 2.5}
