"""Check the documents: decisions that are cited, links, files, and commands are there."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from ident_service.cli import parser
from ident_service.cli.arguments import LOCAL_ONLY

ROOT = Path(__file__).resolve().parents[1]
DECISIONS = ROOT / "docs" / "decisions"
DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
CITATION = re.compile(r"[Dd]ecisions?[\s#]+(\d{4})")
HEADING = re.compile(r"(?m)^#+ (.+)$")


def without_code(text: str) -> str:
    return re.sub(r"(?ms)^```.*?^```$", "", text)


def anchors(document: Path) -> set[str]:
    """The anchors that GitHub gives to headings."""
    headings = HEADING.findall(without_code(document.read_text(encoding="utf-8")))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def sections() -> dict[str, list[str]]:
    """The page and anchor of each decision, by its number."""
    found: dict[str, list[str]] = {}
    for page in DECISIONS.glob("*.md"):
        for anchor in anchors(page):
            if number := re.search(r"-(\d{4})$", anchor):
                found.setdefault(number[1], []).append(f"{page.name}#{anchor}")
    return found


def links(text: str) -> list[str]:
    """Targets of links, in the text or below it; those to other sites are left out."""
    found = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r"(?m)^\[[^\]]+\]: (\S+)$", text)
    return [link for link in found if "://" not in link]


def test_messages_that_troubleshooting_quotes_are_the_program_s() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8").partition("## By fault code")[0]
    quoted = re.findall(r"(?m)^\| `([^`]+)`", page)
    sources = [path.read_text() for place in ("ident_service", "drivers") for path in (ROOT / place).rglob("*.py")]
    assert len(quoted) > 3
    assert [words for words in quoted if not any(words in text for text in sources)] == []


def test_what_no_daemon_does_is_listed_for_programmers() -> None:
    text = (ROOT / "docs" / "programming.md").read_text(encoding="utf-8")
    assert [word for word in LOCAL_ONLY if f"`{word}`" not in text] == []


def citing_files() -> list[Path]:
    places = ("ident_service", "drivers", "sim_backend", "tests", "benchmarks", "configs", "tools", "docs")
    files = [path for place in places for path in (ROOT / place).rglob("*") if path.suffix in (".py", ".yaml", ".md")]
    return [*files, *ROOT.glob("*.md")]


def test_every_cited_decision_has_one_section() -> None:
    known = sections()
    assert {number: places for number, places in known.items() if len(places) != 1} == {}
    cited: dict[str, str] = {}
    for file in citing_files():
        for number in CITATION.findall(re.sub(r"\n[ #]*", " ", file.read_text(encoding="utf-8"))):
            cited[number] = file.relative_to(ROOT).as_posix()
    assert {number: file for number, file in cited.items() if number not in known} == {}
    assert len(cited) > 30


def test_the_index_of_decisions_leads_to_every_section() -> None:
    index = (DECISIONS / "README.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"(?m)^\| (\d{4}) \| \[.*\]\((\S+)\) \|$", index))
    assert rows == {number: places[0] for number, places in sections().items()}
    for page in DECISIONS.glob("*.md"):
        assert page.name == "README.md" or f"]({page.name})" in index, page.name


def test_a_decision_names_only_decisions_that_exist() -> None:
    known = set(sections())
    for page in DECISIONS.glob("*.md"):
        named = set(re.findall(r"(?<![\d.])(00\d\d)\b(?!h)", without_code(page.read_text(encoding="utf-8"))))
        assert named <= known, page.name


@pytest.mark.slow
@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_and_files_of_a_document_exist(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    for link in links(without_code(text)):
        name, _, anchor = link.partition("#")
        target = (document.parent / name).resolve() if name else document
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link
    labels = set(re.findall(r"(?m)^\[([^\]]+)\]: ", text))
    for label in re.findall(r"\[([Dd]ecision \d{4})\]", text):
        assert label.lower() in labels, label
    if document.name != "CHANGELOG.md":  # which tells of files as they were
        for file in re.findall(r"`((?:ident_service|drivers|sim_backend|estimation|motion|tests)/[\w/.]+\.py)`", text):
            assert (ROOT / file).is_file() or (ROOT / "ident_service" / file).is_file(), file


PLACEHOLDER = re.compile(
    r"invalid \w+ value: '[A-Z]+'|a (?:whole )?number|is needed|are required: |expected (?:at least )?one argument"
)
PARSER = parser()
FORMER = {"check", "rehearse", "ack", "base", "correct", "schedule", "alarm", "token", "delete"}
FORMER_LISTS = {("jobs", "list"), ("due", "list")}


def commands(text: str) -> list[list[str]]:
    """The words after `ident` of every command in a block or between backticks."""
    blocks = re.findall(r"(?ms)^```(?:sh|bash)?\n(.*?)^```$", text)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    found = []
    for line in [*lines, *re.findall(r"`([^`\n]+)`", without_code(text).replace("\n", " "))]:
        try:
            words = shlex.split(line.removesuffix(" &"), comments=True)
        except ValueError:
            continue
        if words[:1] == ["ident"] and len(words) > 1 and words[1] not in ("...", "VERB"):
            found.append(words[1:])
    return found


@pytest.mark.parametrize("document", [path for path in DOCUMENTS if path.name != "CHANGELOG.md"], ids=lambda p: p.stem)
def test_commands_of_a_document_are_understood(document: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in commands(document.read_text(encoding="utf-8")):
        assert words[0] not in FORMER, words
        assert tuple(words[:2]) not in FORMER_LISTS, words
        try:
            PARSER.parse_args(words)
        except SystemExit:  # a word in capitals stands for a value, and a command may be named without its arguments
            message = capsys.readouterr().err
            assert not re.search(r"unknown|unexpected| is none of ", message), (words, message)
            assert PLACEHOLDER.search(message) or "--help" in words or "--version" in words, (words, message)


def test_the_page_of_tasks_names_commands() -> None:
    assert len(commands((ROOT / "docs" / "tasks.md").read_text(encoding="utf-8"))) > 50
