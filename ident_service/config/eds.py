"""Read what an EDS (CiA 306-1) says of a drive, as far as a description must know it."""

from __future__ import annotations

import configparser
import re
from functools import lru_cache
from typing import Final

LONGEST: Final = 2**19  # characters, which ini readers take a second for


@lru_cache(maxsize=8)
def maps_dummies(eds: str) -> bool:
    """Tell whether a drive lets 16 bits of a torque frame be another's: `Dummy0003=1` of its EDS (CiA 306-1).

    Args:
        eds: the EDS's text; one that cannot be read says no.
    """
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    try:
        parser.read_string(eds)
        section = next((name for name in parser.sections() if name.lower() == "dummyusage"), None)
        return section is not None and int(parser.get(section, "Dummy0003", fallback="0"), 0) == 1
    except (configparser.Error, ValueError):
        return False


@lru_cache(maxsize=8)
def has_object(eds: str, index: int) -> bool:
    """Return whether an EDS (CiA 306-1) lists an object; one that cannot be read lists none."""
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    try:
        parser.read_string(eds)
    except configparser.Error:
        return False
    return any(name.upper() == f"{index:04X}" for name in parser.sections())


@lru_cache(maxsize=8)
def eds_mistake(eds: str) -> str | None:
    """Why a text is no EDS (CiA 306-1: an ini file with the section DeviceInfo); None where it may be one."""
    if len(eds) > LONGEST:
        return f"longer than {LONGEST} characters"
    if why := _strange_line(eds):
        return why
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    try:
        parser.read_string(eds)
    except configparser.Error as error:
        return str(error).splitlines()[0].removesuffix(" file: '<string>'")
    if not any(name.lower() == "deviceinfo" for name in parser.sections()):
        return "it has no section [DeviceInfo]"
    return None


def _strange_line(eds: str) -> str | None:
    """Find the first line that is no ini file's; Python's reader takes the square of their number to list them all."""
    begun = False
    level: int | None = None  # of the option that deeper lines continue
    for number, line in enumerate(eds.split("\n"), 1):
        text = line.strip()
        indent = len(line) - len(line.lstrip())
        if not text or text[0] in "#;" or (level is not None and indent > level):
            continue
        section, at = re.match(r"\[.+\]", text), re.search("[=:]", text)
        begun = begun or section is not None
        if not begun:
            return None  # the reader says so at once
        if section is None and at is None:
            return f"line {number} is neither a section nor a key with a value: {text[:40]!r}"
        if at is not None and at.start() == 0:
            return f"line {number} has no key: {text[:40]!r}"
        level = None if section else indent
    return None
