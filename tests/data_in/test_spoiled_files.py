"""A good CSV file after a wrong program, or a wrong hand: refused with a remedy, or read as what it was."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_recordings import moving, whole

from ident_service.config.recording import RecordingFormat
from ident_service.errors import RecordingError
from ident_service.recordings.open import open_recording
from ident_service.recordings.resampling import grid

HEADER = "t,q1,q2,tau1,tau2"
JOINTS = ["one", "two"]


def good() -> str:
    block = moving(np.arange(50, dtype=np.int64) * 4_000_000 + 10**9).block
    columns = np.column_stack([block.stamp_ns * 1e-9, block.position, block.torque])
    return "\n".join([HEADER, *(",".join(f"{value:.9f}" for value in row) for row in columns), ""])


def rows(change: Callable[[list[str]], list[str]]) -> Callable[[str], str]:
    """Change the rows behind the header."""
    return lambda text: "\n".join([HEADER, *change(text.splitlines()[1:]), ""])


def times(change: Callable[[int, str], str]) -> Callable[[str], str]:
    """Change the time of every row, which is given with its number."""
    return rows(
        lambda lines: [",".join([change(k, line.split(",")[0]), *line.split(",")[1:]]) for k, line in enumerate(lines)]
    )


REFUSED: dict[str, tuple[Callable[[str], str | bytes], str]] = {
    "commas in decimals": (
        lambda text: text.replace(".", ","),
        "line 2: has 10 fields but the header has 5; are decimals written with commas",
    ),
    "semicolons": (
        lambda text: text.replace(",", ";").replace(".", ","),
        "columns are separated by semicolons; separate them by commas",
    ),
    "tabs": (lambda text: text.replace(",", "\t"), "columns are separated by tabs"),
    "carriage returns": (
        lambda text: text.replace("\n", "\r"),
        "lines end in a carriage return alone; save it with line feeds",
    ),
    "quoted": (lambda text: '"' + text.replace(",", '","').replace("\n", '"\n"'), "names are in quotation marks"),
    "quoted numbers": (
        rows(lambda lines: ['"' + line.replace(",", '","') + '"' for line in lines]),
        "line 2: t is '\"1.000000000\"', not a number",
    ),
    "spaces in names": (lambda text: text.replace("q1", "q 1"), "unknown column 'q 1'; missing q1"),
    "capitals": (lambda text: text.replace(HEADER, HEADER.upper()), "write the names in small letters"),
    "a line of units": (rows(lambda lines: ["s,rad,rad,Nm,Nm", *lines]), "line 2: t is 's', not a number"),
    "a comma more": (lambda text: text.replace("\n", ",\n"), "unknown column ''"),
    "a comma more in rows": (
        rows(lambda lines: [f"{line}," for line in lines]),
        "line 2: has 6 fields but the header has 5; the row is torn",
    ),
    "the index of a table": (
        rows(lambda lines: [f"{k},{line}" for k, line in enumerate(lines)]),
        "line 2: has 6 fields but the header has 5",
    ),
    "long minus": (rows(lambda lines: [line.replace(",", ",\u2212", 1) for line in lines]), "line 2: q1 is '\u2212"),
    "spreadsheet error": (
        rows(lambda lines: [*lines[:3], lines[3].rsplit(",", 1)[0] + ",#N/A"]),
        "line 5: tau2 is '#N/A', not a number",
    ),
    "letter of Fortran": (rows(lambda lines: [f"{line}d0" for line in lines]), "d0', not a number"),
    "nothing": (lambda text: "", "is empty; record again, or give another file"),
    "header alone": (lambda text: f"{HEADER}\n", "holds fewer than two samples"),
    "zeros of a full disk": (lambda text: f"{text}{4096 * chr(0)}", "is neither MCAP nor CSV (plain or gzip)"),
    "one row": (rows(lambda lines: lines[:1]), "holds fewer than two samples; record the motion again"),
    "end cut off": (
        lambda text: text[:-30],
        "line 51: has 3 fields but the header has 5; the row is torn or malformed, remove it",
    ),
    "twice": (lambda text: text + text, "line 52: t is 't', not a number"),
    "rows twice": (
        rows(lambda lines: lines + lines),
        "line 52, 0.000000 s after the first: the stamp does not increase, it runs back by 0.196",
    ),
    "backwards": (rows(lambda lines: lines[::-1]), "line 3, -0.004000 s after the first: the stamp does not increase"),
    "one time": (
        times(lambda k, time: "1.0"),
        "line 3, 0.000000 s after the first: the stamp does not increase, but the values change",
    ),
    "two decimals": (times(lambda k, time: time[:4]), "the stamp does not increase, but the values change"),
    "milliseconds since 1970": (
        times(lambda k, time: str(1_700_000_000_000 + 4 * k)),
        "line 2: time t is 1700000000000; not in seconds? Name its unit: recording.columns: {t: {column: NAME, "
        "unit: ms}}",
    ),
    "microseconds since 1970": (
        times(lambda k, time: str(1_700_000_000_000_000 + 4000 * k)),
        "{t: {column: NAME, unit: us}}",
    ),
    "nanoseconds since 1970": (
        times(lambda k, time: str(1_700_000_000_000_000_000 + 4_000_000 * k)),
        "{t: {column: NAME, unit: ns}}",
    ),
    "infinite": (
        rows(lambda lines: [*lines[:3], lines[3].rsplit(",", 1)[0] + ",1e999"]),
        "line 5, 0.012000 s after the first: torque of joint two is inf",
    ),
    "page": (lambda text: "<!DOCTYPE html><html><body>404</body></html>", "is HTML or XML, a page and no recording"),
    "spreadsheet": (lambda text: b"PK\x03\x04" + bytes(range(256)), "is neither MCAP nor CSV"),
    "two bytes a letter": (lambda text: text.encode("utf-16"), "is text in UTF-16; save it as UTF-8"),
    "torn archive": (lambda text: gzip.compress(text.encode())[:-20], "cannot be read beyond 0 bytes of text"),
    "a joint less": (
        lambda text: "\n".join(
            line.rsplit(",", 1)[0]
            for line in text.replace("q2", "tau1").replace("tau1,tau1,tau2", "tau1,b").splitlines()
        ),
        "has 1 joints but the arm has 2",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_spoiled_file_is_refused_with_its_place(name: str, tmp_path: Path) -> None:
    spoil, words = REFUSED[name]
    content = spoil(good())
    (tmp_path / "run.csv").write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(RecordingError) as caught:
        grid(open_recording(tmp_path / "run.csv", JOINTS), RecordingFormat())
    assert words in str(caught.value)
    assert str(caught.value).startswith(f"{tmp_path}/run.csv: ")


def swapped_rows(lines: list[str]) -> list[str]:
    return [*lines[:5], lines[6], lines[5], *lines[7:]]


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (REFUSED["infinite"][0], "remove this sample, and others like it"),
        (rows(lambda lines: [*lines[:9], f"{lines[8].split(',')[0]},9,9,9,9", *lines[9:]]), "remove this sample"),
        (rows(swapped_rows), "remove this sample"),
        (REFUSED["rows twice"][0], "remove the samples from there on"),
        (rows(lambda lines: [*lines, lines[0]]), "remove the samples from there on"),
    ],
)
def test_one_bad_sample_costs_no_others(spoil: Callable[[str], str], words: str, tmp_path: Path) -> None:
    """For one infinite torque or one repeated stamp the rest of the recording was to go."""
    (tmp_path / "run.csv").write_text(spoil(good()))
    with pytest.raises(RecordingError, match=f"; {words}"):
        grid(open_recording(tmp_path / "run.csv", JOINTS), RecordingFormat())


READ: dict[str, Callable[[str], str]] = {
    "byte order mark": lambda text: f"\ufeff{text}",
    "line ends of Windows": lambda text: text.replace("\n", "\r\n"),
    "spaces": lambda text: text.replace(",", ", "),
    "no last line end": lambda text: text.rstrip(),
    "empty lines behind": lambda text: f"{text}\n\n",
    "columns in another order": lambda text: "\n".join(",".join(line.split(",")[::-1]) for line in text.splitlines()),
    "every row twice": rows(lambda lines: [line for line in lines for _ in range(2)]),
}


@pytest.mark.parametrize("name", READ)
def test_what_says_the_same_is_read_as_the_same(name: str, tmp_path: Path) -> None:
    parts = []
    for content in (good(), READ[name](good())):
        (tmp_path / "run.csv").write_text(content, encoding="utf-8", newline="")
        parts.append(whole(open_recording(tmp_path / "run.csv", JOINTS)))
    for one, other in zip(*((part.stamp_ns, part.position, part.torque) for part in parts), strict=True):
        assert np.array_equal(one, other)
