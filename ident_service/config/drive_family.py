"""Describe maker-specific properties of drives: data files beside the driver, or beside a user's description.

A family replaces what differs from `generic402`, whose lists are the fallbacks of CiA 402 in their order. An entry is
written `6071:0/i16`: index and sub-index in hexadecimal digits, and its type.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from ident_service.config.quantities import Positive, Section
from ident_service.errors import DriverError

EntryText = Annotated[str, Field(pattern=r"^[0-9A-F]{4}:[0-9A-F]{1,2}/[iu](8|16|32)$")]
Unsigned32 = Annotated[int, Field(strict=True, ge=0, le=0xFFFF_FFFF)]
TargetText = Annotated[str, Field(pattern=r"^[0-9A-F]{4}:[0-9A-F]{1,2}/i(16|32)$")]
_MOST_CONTROL = 0xFFFF
_MOST_MODE = 127
_NEEDS_NO_SOURCE = frozenset({"name", "proved", "sources", "notes"})


class Match(Section):
    """Identity of the drives in a family (1018h:01, 1018h:02); an empty `product` matches all of the vendor's."""

    vendor: Unsigned32 | None = None
    product: tuple[Unsigned32, ...] = ()


class ModeEntry(Section):
    """Maker-specific entry that replaces 6060h; `display` reads back the mode in effect."""

    entry: EntryText
    display: EntryText


class TorquePath(Section):
    """Way to stream torques: a mode, its bit in 6502h where it has one, and the entry that takes the torque.

    A target of 32 bits takes counts shifted by `shift` bits. `writes` are entries that the mode needs set, with their
    values; `enabling` are bits of the control word without which an enabled drive does not follow its target.
    """

    mode: Annotated[int, Field(strict=True, ge=-128, le=0xFFFF)]
    supported: Annotated[int, Field(strict=True, ge=0, le=31)] | None = None
    target: TargetText
    by: ModeEntry | None = None
    slope: EntryText | None = None
    shift: Annotated[int, Field(strict=True, ge=0, le=16)] = 0
    writes: dict[EntryText, Annotated[int, Field(strict=True)]] = Field(default={})
    enabling: Annotated[int, Field(strict=True, ge=0, le=_MOST_CONTROL)] = 0

    @property
    def wide(self) -> bool:
        """Return whether the torque target is an entry of 32 bits, of which a frame carries only one."""
        return self.target.endswith("/i32")

    @model_validator(mode="after")
    def _fits(self) -> TorquePath:
        if self.shift and not self.wide:
            raise ValueError("only counts in a target of 32 bits are shifted")
        if self.by is None and self.mode > _MOST_MODE:
            raise ValueError(f"mode {self.mode} does not fit 6060h; `by` names the maker's own entry")
        return self


class PositionPath(Section):
    """Way to stream positions: a mode, its bit in 6502h, and the entry that takes the position [counts]."""

    mode: Annotated[int, Field(strict=True, ge=-128, le=_MOST_MODE)]
    supported: Annotated[int, Field(strict=True, ge=0, le=31)] | None = None
    target: Annotated[str, Field(pattern=r"^[0-9A-F]{4}:[0-9A-F]{1,2}/i32$")]
    by: None = None
    slope: None = None
    writes: dict[EntryText, int] = Field(default={}, max_length=0)
    enabling: Literal[0] = 0


class TorqueUnit(Section):
    """Size of a count of the target: a thousandth of `rated`, or `count`, in `unit`; `mA` needs a torque constant.

    `cNm` is for drives that count N m x 100 (Roboteq's 6071h: `count: 1`), `own` for drives that count a current in a
    unit of their own, which a description gives (`drives.current_unit`).
    """

    rated: EntryText | None = None
    count: Positive | None = None
    unit: Literal["mNm", "uNm", "cNm", "mA", "own"]
    writable: bool = False

    @model_validator(mode="after")
    def _require_rated_or_count(self) -> TorqueUnit:
        if (self.rated is None) == (self.count is None):
            raise ValueError("either `rated` names an entry, or `count` is a number")
        if self.writable and (self.rated is None or self.counts_are_current):
            raise ValueError("only a rated torque in mNm, uNm or cNm is written")
        return self

    @property
    def counts_are_current(self) -> bool:
        """Return whether the drive's torque counts are counts of motor current: `unit` is `mA` or `own`."""
        return self.unit in ("mA", "own")


class TorqueLimit(Section):
    """Entry of the largest torque, in counts of the target or thousandths of `per`; `negative`: other direction.

    With `below`, the entry holds how far the largest torque is below this number of counts.
    """

    entry: EntryText
    per: EntryText | None = None
    negative: EntryText | None = None
    below: Annotated[int, Field(strict=True, ge=1)] | None = None

    def entry_or_limit(self, counts: int) -> int:
        """Convert a limit [counts] to the entry's value, or back: unchanged, or `below` less the limit, at least 0."""
        return counts if self.below is None else max(self.below - counts, 0)


class MakersWatchdog(Section):
    """Maker-specific entry that sets the drive's watchdog on missing torque frames."""

    entry: EntryText
    unit: str
    option: EntryText | None = None


class Family(Section):
    """Known properties of a family of drives.

    `refuse` is the sentence with which drives without a torque mode are refused. `mode_shown` says in which state a
    mode of operation takes effect (6061h): already while the drive is off, or only when it is switched on.
    `brake` is the maker's entry in which its tool has set up a holding brake, which is shown and never written.
    `sources` says for every other key where it is from; `proved` whether somebody has run it on hardware.
    """

    name: Annotated[str, Field(min_length=1)]
    proved: bool
    match: Match = Match()
    refuse: str = ""
    torque: tuple[TorquePath, ...] = ()
    position: PositionPath | None = None
    unit: TorqueUnit | None = None
    torque_limit: tuple[TorqueLimit, ...] = ()
    speed_limit: tuple[EntryText, ...] = ()
    dummies: tuple[Literal["0003", "0006", "0005", "0002"], ...] | None = None
    watchdog: MakersWatchdog | None = None
    mode_shown: Literal["off", "switched_on"] = "off"
    brake: EntryText | None = None
    notes: str = ""
    sources: dict[str, Annotated[str, Field(min_length=1)]]

    @model_validator(mode="after")
    def _every_fact_has_a_source(self) -> Family:
        given = self.model_fields_set - _NEEDS_NO_SOURCE
        if empty := [key for key in sorted(given) if getattr(self, key) is None]:
            raise ValueError(f"{', '.join(empty)}: leave out what is not known")
        if given != self.sources.keys():
            raise ValueError(f"sources are needed for {', '.join(sorted(given))}; there are {', '.join(self.sources)}")
        return self

    def completed_by(self, generic: Family) -> Family:
        """Return a copy of `generic` in which the keys that this family's file sets replace its own."""
        return generic.model_copy(update={key: getattr(self, key) for key in self.model_fields_set})


def parse_family(file_name: str, text: str) -> Family:
    """Read the description of a drive family from YAML text; raises DriverError if it does not fit the schema.

    Args:
        file_name: of the file.
        text: content of the file, as YAML.

    Raises:
        DriverError: it is no family; the message says why.
    """
    import yaml  # where a family is read; a motion's process needs none

    try:
        content: Any = yaml.safe_load(text)
        return Family.model_validate(content)
    except (yaml.YAMLError, ValidationError, RecursionError) as error:
        raise DriverError(f"{file_name} is no family of drives: {error}") from None
