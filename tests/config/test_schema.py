"""The published schema and reference of descriptions: equal to the models, complete, and kept by every shipped file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml
from config.test_config_mistakes import GOOD

from ident_service.cli import main
from ident_service.config.yaml_source import MODELINE, arm_schema_file, shipped_arms
from tools.description_reference import arm_schema, reference
from tools.description_reference import main as write_published

ROOT = Path(__file__).parents[2]
RENEW = "run: python tools/description_reference.py"


@pytest.fixture(scope="module")
def schema() -> dict[str, Any]:
    return arm_schema()


def keys(schema: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Section, key and schema of every key."""
    for name, section in {"": schema, **schema["definitions"]}.items():
        for one in (section, *section.get("anyOf", ())):
            for key, value in one.get("properties", {}).items():
                yield name, key, value


def is_number(part: dict[str, Any], schema: dict[str, Any]) -> bool:
    """Return whether a value, or each of a list or mapping of them, can be a number."""
    if "$ref" in part:
        return is_number(schema["definitions"][part["$ref"].rpartition("/")[2]], schema)
    inside = [*part.get("anyOf", ()), *part.get("allOf", ())]
    inside += [one for one in (part.get("items"), part.get("additionalProperties")) if isinstance(one, dict)]
    return part.get("type") in ("number", "integer") or any(is_number(one, schema) for one in inside)


@pytest.mark.slow
def test_the_published_files_are_those_of_the_models(schema: dict[str, Any]) -> None:
    assert json.loads(arm_schema_file().read_text()) == schema, RENEW
    assert (ROOT / "docs" / "reference-description.md").read_text() == reference(), RENEW


@pytest.mark.campaign
def test_the_command_that_the_page_names_writes_both(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = [arm_schema_file(), ROOT / "docs" / "reference-description.md"]
    files = [tmp_path / "schema.json", tmp_path / "page.md"]
    assert write_published([str(one) for one in files]) == 0
    for made, published in zip(files, before, strict=True):
        assert made.read_bytes() == published.read_bytes()
    with pytest.raises(SystemExit) as refused:
        write_published([str(tmp_path / "nowhere" / "schema.json")])
    assert refused.value.code == 2
    assert f"there is no folder {tmp_path / 'nowhere'}" in capsys.readouterr().err
    # Without arguments it takes the checkout's own files.
    assert write_published([]) == 0
    assert [path.read_text() for path in before] == [path.read_text() for path in files]


def test_every_key_says_what_it_is_in_which_unit_and_what_counts_without_it(schema: dict[str, Any]) -> None:
    found = list(keys(schema))
    assert len(found) > 280
    assert [place for *place, one in found if not one.get("description", "").endswith(".")] == []
    # `options` are python-can's, in whatever units those have.
    numbers = [(name, key, one) for name, key, one in found if is_number(one, schema) and key != "options"]
    assert [(name, key) for name, key, one in numbers if "x-unit" not in one and "const" not in one] == []
    without = {(name, key) for name, key, one in found if "default" not in one and "x-required" not in one}
    sections = {(name, key) for name, key, one in found if "$ref" in json.dumps(one) or one.get("type") == "object"}
    assert without - sections == {("", "extends")}


@pytest.mark.slow
def test_no_link_of_the_reference_is_dead_and_no_heading_stands_twice() -> None:
    lines = reference().splitlines()
    titles = [line.removeprefix("## ") for line in lines if line.startswith("## ")]
    slugs = ["".join(c for c in title.lower() if c.isalnum() or c in "_- ").replace(" ", "-") for title in titles]
    assert len(set(slugs)) == len(slugs) > 40
    linked = {part.partition(")")[0] for line in lines for part in line.split("](#")[1:]}
    assert linked <= set(slugs)


@pytest.mark.parametrize("arm", sorted(shipped_arms()))
def test_shipped_descriptions_name_the_schema_and_keep_it(arm: str, schema: dict[str, Any]) -> None:
    text = shipped_arms()[arm].read_text()
    assert text.splitlines()[0] == MODELINE
    assert arm_schema_file().parent == shipped_arms()[arm].parent  # which the first line says
    assert list(jsonschema.Draft7Validator(schema).iter_errors(yaml.safe_load(text))) == []


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("rate: 1000", "rat: 1000"),
        ("rate: 1000", "rate: fast"),
        ("rate: 1000", "rate: -1"),
        ("kind: seeded", "kind: wobble"),
        ("alpha: pi/2", "alpha: upwards"),
        ("convention: standard", "convention: odd"),
        ("kind: simulated", "kind: simulated, node: 3"),
    ],
)
def test_the_schema_refuses_what_the_reader_refuses(old: str, new: str, schema: dict[str, Any]) -> None:
    assert old in GOOD
    check = jsonschema.Draft7Validator(schema)
    check.check_schema(schema)
    assert check.is_valid(yaml.safe_load(GOOD))
    assert not check.is_valid(yaml.safe_load(GOOD.replace(old, new)))


@pytest.mark.parametrize("format_", ["arm", "comparison", "evidence", "parameters", "payload"])
def test_the_command_prints_schemas(format_: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema", format_]) == 0
    assert json.loads(capsys.readouterr().out)["title"] == f"ident-{format_}"
