"""Renew the scripts of others that pages bring along, from the npm registry.

`python tools/renew_viewer.py PACKAGE [VERSION]` needs npm, which checks the package against the registry's own hash. It
writes the package's files, its licence and its document (name, version, licence, SHA-256 of each file), which a test
reads. Look at the pages afterwards: `pytest tests/page` does so in a browser, offline. Packages: `rapidoc`, the viewer
of the API's description at `/api/docs`; `uplot`, which draws time series; `three`, which draws the arm.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Any, Final

# Of each package: its document, and which of its files become which of ours.
PACKAGES: Final[dict[str, tuple[str, dict[str, str]]]] = {
    "rapidoc": (
        "rapidoc.json",
        {
            "package/dist/rapidoc-min.js": "rapidoc-min.js",
            "package/dist/rapidoc-min.js.LICENSE.txt": "rapidoc-min.js.LICENSE.txt",
            "package/LICENSE.txt": "rapidoc.LICENSE.txt",
        },
    ),
    "uplot": (
        "uplot.json",
        {
            "package/dist/uPlot.iife.min.js": "uPlot.iife.min.js",
            "package/dist/uPlot.min.css": "uPlot.min.css",
            "package/LICENSE": "uPlot.LICENSE.txt",
        },
    ),
    # From 0.186 on it comes without minified files; name an earlier version, as 0.185.1.
    "three": (
        "three.json",
        {
            "package/build/three.core.min.js": "three.core.min.js",
            "package/build/three.module.min.js": "three.module.min.js",
            "package/LICENSE": "three.LICENSE.txt",
        },
    ),
}
PLACE = Path(__file__).resolve().parents[1] / "ident_service" / "vendored"


def main(words: list[str]) -> None:
    """Fetch one version of a package, the newest if none is named."""
    if not words or words[0] not in PACKAGES:
        raise SystemExit(f"name the package: {', '.join(PACKAGES)}")
    name, *version = words
    renew(name, "@".join([name, *version[:1]]))


def renew(name: str, wanted: str) -> None:
    """Write the files of a package and its document."""
    document, files = PACKAGES[name]
    with tempfile.TemporaryDirectory() as folder:
        packed = subprocess.run(  # noqa: S603 - npm of whoever renews
            ["npm", "pack", "--json", "--ignore-scripts", wanted],  # noqa: S607
            cwd=folder,
            check=True,
            capture_output=True,
            text=True,
        )
        found: Any = json.loads(packed.stdout)
        told = found[0] if isinstance(found, list) else next(iter(found.values()))
        hashes = {}
        with tarfile.open(Path(folder) / told["filename"]) as package:
            for inside, own in files.items():
                stream = package.extractfile(inside)
                if stream is None:
                    raise SystemExit(f"{wanted}: has no {inside}")
                content = stream.read()
                (PLACE / own).write_bytes(content)
                hashes[own] = hashlib.sha256(content).hexdigest()
            stream = package.extractfile("package/package.json")
            licence = "" if stream is None else json.loads(stream.read())["license"]
    told_of_it = {
        "package": name,
        "version": told["version"],
        "licence": licence,
        "integrity": told["integrity"],
        "sha256": hashes,
    }
    (PLACE / document).write_text(json.dumps(told_of_it, indent=1) + "\n", encoding="utf-8")
    print(f"{name} {told['version']} ({licence}): {', '.join(hashes)}")


if __name__ == "__main__":
    main(sys.argv[1:])
