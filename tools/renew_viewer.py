"""Renew the viewer of the API's description that pages bring along, from the npm registry.

`python tools/renew_viewer.py [VERSION]` needs npm, which checks the package against the registry's own hash. It writes
the viewer, its licence and `vendored.json` (name, version, licence, SHA-256 of each file), which a test reads. Look at
the page `/api/docs` afterwards: `pytest tests/page/test_api_docs.py` does so in a browser, offline.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Any

PACKAGE = "rapidoc"
FILES = {
    "package/dist/rapidoc-min.js": "rapidoc-min.js",
    "package/dist/rapidoc-min.js.LICENSE.txt": "rapidoc-min.js.LICENSE.txt",
    "package/LICENSE.txt": "LICENSE.txt",
}
PLACE = Path(__file__).resolve().parents[1] / "ident_service" / "daemon" / "web" / "vendored"


def main(words: list[str]) -> None:
    """Fetch one version, the newest if none is named."""
    wanted = f"{PACKAGE}@{words[0]}" if words else PACKAGE
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
            for inside, name in FILES.items():
                stream = package.extractfile(inside)
                if stream is None:
                    raise SystemExit(f"{wanted}: has no {inside}")
                content = stream.read()
                (PLACE / name).write_bytes(content)
                hashes[name] = hashlib.sha256(content).hexdigest()
            stream = package.extractfile("package/package.json")
            licence = "" if stream is None else json.loads(stream.read())["license"]
    document = {
        "package": PACKAGE,
        "version": told["version"],
        "licence": licence,
        "integrity": told["integrity"],
        "sha256": hashes,
    }
    (PLACE / "vendored.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    print(f"{PACKAGE} {told['version']} ({licence}): {', '.join(hashes)}")


if __name__ == "__main__":
    main(sys.argv[1:])
