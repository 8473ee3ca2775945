"""Read XML that has passed `require_parser_limits`, names with undeclared prefixes as they are."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from xml.parsers import expat

from ident_service.errors import ModelError


def parse_xml(text: str) -> ET.Element:
    """Parse XML after `require_parser_limits`, undeclared prefixes kept; return its root; ModelError if malformed.

    Tools of simulators add attributes such as `drake:acceleration`, and often do not declare their prefixes.

    Raises:
        ModelError: not well-formed.
    """
    builder, parser = ET.TreeBuilder(), expat.ParserCreate("utf-8")
    parser.StartElementHandler = lambda tag, attributes: builder.start(tag, attributes)
    parser.EndElementHandler = builder.end
    try:
        parser.Parse(text.encode("utf-8", "surrogatepass"), True)
    except expat.ExpatError as error:
        raise ModelError(f"not well-formed XML: {error}") from None
    return builder.close()
