"""Determine a drive's family, from the arm's description or else from the data files beside this module."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

from drivers.canopen.object_dictionary import Entry, Kind
from ident_service.config.family import Family, family_from

_FOLDER = Path(__file__).parent / "profiles"
GENERIC = "generic402"


@lru_cache(maxsize=1)
def shipped_families() -> tuple[Family, ...]:
    """Return the families that come with the driver, the generic one last."""
    files = sorted(_FOLDER.glob("*.yaml"), key=lambda path: (path.stem == GENERIC, path.stem))
    return tuple(family_from(path.name, path.read_text(encoding="utf-8")) for path in files)


def family_of(identity: Mapping[str, int], own: Sequence[Family] = ()) -> Family:
    """Return the family of a drive, with what it leaves open as in `generic402`.

    Args:
        identity: values of 1018h, by the keys `vendor` and `product`.
        own: families of the arm's description, which count before the shipped ones.
    """
    vendor, product = identity.get("vendor"), identity.get("product")
    *shipped, generic = shipped_families()
    makers = [one for one in (*own, *shipped) if one.match.vendor is not None and one.match.vendor == vendor]
    exact = [one for one in makers if product in one.match.product]
    found = [*exact, *(one for one in makers if not one.match.product)]
    return found[0].over(generic) if found else generic


def entry_of(text: str, name: str, unit: str = "") -> Entry:
    """Return an entry that a family names, such as `6071:0/i16`."""
    where, kind = text.split("/")
    index, sub = where.split(":")
    return Entry(int(index, 16), int(sub, 16), Kind[kind.upper()], name, unit)
