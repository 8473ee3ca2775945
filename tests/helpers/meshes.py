"""An arm whose links have meshes: the shipped `threelink` with a file for each of three links."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ident_service.config.load import shipped_arms

CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
FACES = (
    *((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)),
    *((2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)),
)
COLUMN = '<visual><origin xyz="0 0 0.15" rpy="0 0 0.5"/><geometry><mesh filename="{}" scale="0.001 0.001 0.001"/>'
PLAIN = '<visual><geometry><mesh filename="{}"/>'
COLLADA = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="meter" meter="1"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="24">{points}</float_array><technique_common>
<accessor source="#a" count="8" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
</accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="12"><input semantic="VERTEX" source="#v" offset="0"/><p>{faces}</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene>
</COLLADA>
"""


def stl(corners: NDArray[np.float64]) -> bytes:
    """Write triangles, shape (triangles, 3, 3), as a binary STL."""
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    rows = np.zeros(len(corners), record)
    rows["corners"] = corners
    return b"written by a test".ljust(80) + np.array(len(corners), "<u4").tobytes() + rows.tobytes()


def box(*half: float) -> NDArray[np.float64]:
    """Return the twelve triangles of a box about the origin, shape (12, 3, 3)."""
    return (CORNERS * half)[np.array(FACES)]


def threelink(name: str = "threelink") -> tuple[str, str, dict[str, bytes]]:
    """Return description, URDF and meshes of an arm: column (STL in mm), arm (OBJ), boom and tool (COLLADA)."""
    path = shipped_arms()["threelink"]
    text = path.read_text(encoding="utf-8").replace("name: threelink", f"name: {name}")
    urdf = path.with_name("threelink.urdf").read_text(encoding="utf-8")
    for link, part in {
        "column": COLUMN.format("package://crane/meshes/visual/column.stl"),
        "arm": PLAIN.format("../meshes/arm.obj"),
        "boom": PLAIN.format("boom.dae"),
        "tool": PLAIN.format("boom.dae"),
    }.items():
        urdf = urdf.replace(f'<link name="{link}">', f'<link name="{link}">{part}</geometry></visual>')
    urdf = urdf.replace("<robot ", '<robot drake:version="1" ')  # of a simulator's tool, which declares no prefix
    obj = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS * (0.12, 0.03, 0.03))
    obj += "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in FACES)
    points = " ".join(map(str, (CORNERS * 0.02).ravel()))
    dae = COLLADA.format(points=points, faces=" ".join(str(one) for face in FACES for one in face))
    meshes = {"column.stl": stl(box(50.0, 40.0, 150.0)), "arm.obj": obj.encode(), "boom.dae": dae.encode()}
    return text, urdf, meshes
