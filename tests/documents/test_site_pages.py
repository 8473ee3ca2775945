"""The documents hold: their commands run, every fault has its entry, tables and figures are those of the code."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from documents.walk import BLOCK, PORT, ROOT, Block, blocks, script, walk

from ident_service.motion.fault_store import UNFINISHED
from ident_service.motion.faults import FAULTS, HOLD, LOWER, LOWER_AFTER, Reaction
from ident_service.motion.state_machine import TRANSITIONS
from ident_service.motion.ticket import CODES
from ident_service.operations.arm_checks import TITLES

DOCS = ROOT / "docs"
# The newcomer's walk; at night with what else the same folder is good for, and the arm of one's own.
WALKS = (
    ("../README.md", "tutorial.md", "reference/command-line.md", "troubleshooting.md"),
    (
        *("../README.md", "tutorial.md", "identify-recordings.md", "reidentification.md", "reference/python-api.md"),
        *("concepts/base-parameters.md", "concepts/excitation.md", "tasks.md", "security.md", "troubleshooting.md"),
        "reference/command-line.md",
    ),
    ("your-own-arm.md", "commissioning.md"),
    (
        *("tutorial.md", "identify-recordings.md", "recordings.md", "ros.md", "service.md", "fleet.md"),
        "extending.md",
    ),
)
NIGHTLY = WALKS[1:]
REACTIONS = {
    "Warning": Reaction.WARN,
    "Controlled stop": Reaction.CONTROLLED_STOP,
    "Damped lowering": Reaction.DAMPED_LOWERING,
    "Quick stop": Reaction.QUICK_STOP,
    "Torque off": Reaction.TORQUE_OFF,
}


def text(page: str) -> str:
    return (DOCS / page).read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "pages",
    [
        pytest.param(pages, marks=pytest.mark.campaign if pages in NIGHTLY else (), id=Path(pages[-1]).stem)
        for pages in WALKS
    ],
)
def test_the_commands_of_the_pages_run(pages: tuple[str, ...], tmp_path: Path) -> None:
    done = walk([DOCS / page for page in pages], tmp_path)
    assert done.returncode == 0, done.stdout[-3000:]
    asked = sum(block.text.count("ident ") for page in pages for block in blocks(text(page)) if block.language == "sh")
    assert asked > 9
    assert done.stdout.count("\n+ ident ") + done.stdout.startswith("+ ident ") > 9


@pytest.mark.campaign
@pytest.mark.timeout(3600)
def test_a_newcomer_gets_there_in_a_clean_clone() -> None:
    pages = [ROOT / "README.md", *(DOCS / f"{page}.md" for page in ("tutorial", "identify-recordings", "your-own-arm"))]
    command = [sys.executable, str(ROOT / "tests" / "documents" / "walk.py"), "--clean", *map(str, pages)]
    subprocess.run(command, check=True)


def test_every_page_with_commands_is_walked() -> None:
    with_commands = {
        path.relative_to(DOCS).as_posix()
        for path in DOCS.rglob("*.md")
        if any(block.language == "sh" for block in blocks(path.read_text(encoding="utf-8")))
    }
    assert with_commands <= {page for pages in WALKS for page in pages}


def test_commands_stand_in_blocks_that_are_walked() -> None:
    command = re.compile(r"(?m)^(?:ident|make|pip|sudo|systemctl|podman|ros2|dask|ip) .*")
    for path in sorted(DOCS.rglob("*.md")):
        for found in BLOCK.finditer(path.read_text(encoding="utf-8")):
            if found["language"] != "sh":
                assert command.findall(found["text"]) == [], path
    skipped = re.findall(r"walk: skip, (?:needs|the test) ", "".join(map(Path.read_text, DOCS.rglob("*.md"))))
    assert len(skipped) == "".join(map(Path.read_text, DOCS.rglob("*.md"))).count("walk: skip")  # each says why


def test_a_walk_ends_at_the_first_command_that_does_not_end_as_its_page_says(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "```sh\ntrue\nfalse # exit code 1: no\n(exit 3) # exit code 0 or 3\n```\n\n"
        "<!-- walk: skip, it is for people -->\n```sh\nexit 9\n```\n\n"
        "<!-- walk: first echo made -->\n```yaml\n# a.yaml\nb: 1\n```\n\n"
        "<!-- file: c.json -->\n```json\n{}\n```\n\n```sh\ncat a.yaml \\\n  c.json\nfalse\necho not reached\n```\n"
    )
    done = subprocess.run(["bash", "-c", script([page])], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == "page.md:26: false: exit code 1 instead of 0\n"
    assert "made\n" in done.stdout
    assert "# a.yaml\nb: 1\n{}\n" in done.stdout
    assert "not reached" not in done.stdout
    assert list(blocks("```text\nx\n```\n```yaml\nkey: 1\n```\n")) == []
    assert list(blocks("```python\nx\n```\n")) == [Block("python", "x\n", 2)]


def test_the_port_of_the_documents_is_that_of_the_daemon() -> None:
    assert f"http://127.0.0.1:{PORT}" in text("tutorial.md")


def test_the_readme_is_one_page() -> None:
    readme = text("../README.md")
    assert len(readme.split()) <= 700
    assert len(re.findall(r"!\[", readme)) == 1
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for page in ("../README.md", "../CONTRIBUTING.md"):
        for target in re.findall(
            r"\bmake ([a-z-]+)\b", "\n".join(re.findall(r"`make [^`]+`|^make .*$", text(page), re.M))
        ):
            assert re.search(rf"(?m)^{target}:", makefile), (page, target)


def test_every_fault_has_an_entry_with_three_checks() -> None:
    page = text("troubleshooting.md").partition("## By fault code")[2]
    entries = dict(re.findall(r"(?ms)^#### `(\w+)`\n(.*?)(?=^#|\Z)", page))
    # Of a process that ended without a word: nobody reacted but the drives.
    assert re.findall(r"(?m)^(\d)\. \S", entries.pop(UNFINISHED)) == ["1", "2", "3"]
    assert sorted(entries) == sorted(FAULTS)
    for code, entry in entries.items():
        begins = re.match(r"\n\*([A-Z][a-z ]+)\.\* \S.*\n\n", entry)
        assert begins is not None, code
        assert REACTIONS[begins[1]] is FAULTS[code].reaction, code
        assert re.findall(r"(?m)^(\d)\. \S", entry) == ["1", "2", "3"], code


@pytest.mark.parametrize(
    ("page", "heading"),
    [
        ("fieldbus.md", "## What the arm does at each end, and what a person must do"),
        ("commissioning.md", "## What a person must do at each end of a motion"),
    ],
)
def test_what_a_person_must_do_at_each_end_describes_what_the_code_does(page: str, heading: str) -> None:
    told = text(page).partition(heading)[2].partition("\n## ")[0]
    rows = re.findall(r"(?m)^\| (.*) \|$", told)
    named = {code: row for row in rows for code in re.findall(r"`(\w+)`", row.split("|")[0]) if code in FAULTS}
    let_go = (Reaction.DAMPED_LOWERING, Reaction.TORQUE_OFF)
    assert sorted(named) == sorted(code for code, rule in FAULTS.items() if rule.reaction in let_go)
    for code, row in named.items():
        if FAULTS[code].reaction is Reaction.TORQUE_OFF:
            assert "**it falls**" in row, code
            assert "keep out of its reach" in row or row.endswith("the same"), code
        else:
            assert f"lowered for {LOWER_AFTER + LOWER:g} s" in row, code
    (stopped,) = (row for row in rows if row.startswith(("a stop, ", "`ident home` is done; a stop")))
    assert stopped.count(f"held for {HOLD:g} s") == 2
    assert "`ident supported ARM`" in stopped
    (quick,) = (row for row in rows if row.startswith("quick stop"))
    assert "**fall" in quick or "**it falls**" in quick
    assert "upport it" in quick


def test_every_row_of_the_preflight_is_explained() -> None:
    rows = re.findall(r"(?m)^\| ([^|]+) \| `(\w+)` \| [^|]+ \| [^|]+ \|$", text("commissioning.md"))
    assert [code for _, code in rows] == list(CODES)
    assert {code: title for title, code in rows} == TITLES


def test_the_figure_of_the_states_is_that_of_the_code() -> None:
    drawn = (DOCS / "images" / "states.svg").read_text(encoding="utf-8")
    for one, many in TRANSITIONS.items():
        assert re.search(rf"[>\s]{one.value}: {' '.join(to.value for to in many)}[;<]", drawn), "make docs-figures"


def test_every_picture_is_shown_and_small() -> None:
    shown = set(re.findall(r"images/([\w-]+\.(?:png|svg))", "".join(map(Path.read_text, DOCS.rglob("*.md")))))
    there = {path.name: path.stat().st_size for path in (DOCS / "images").iterdir()}
    assert sorted(there) == sorted(shown)
    assert max(there.values()) <= 150_000


def test_every_page_has_its_place_in_the_site() -> None:
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    named = re.findall(r"[\w/-]+\.md", nav)
    assert sorted(named) == sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))
