"""Gaussians as binary glTF (GLB) with the extension KHR_gaussian_splatting: points with attributes.

Scales and opacities are stored after their activation, quaternions as xyzw, coefficients one attribute each. Positions
are turned so that y points up, as glTF wants it. Programs that do not know the extension show coloured points. Source:
the README of KHR_gaussian_splatting in KhronosGroup/glTF (scales were logarithms in early drafts; they are linear now).
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.export.splats import Splats, WrittenSplats, drawable, turned_y_up
from thermosplat.runs.atomic_writes import write_bytes
from thermosplat.scene.gaussians import SH_C0

EXTENSION = "KHR_gaussian_splatting"
_FLOAT, _BYTE, _POINTS, _VERTICES = 5126, 5121, 0, 34962  # glTF's numbers
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_glb(path: Path, splats: Splats, *, name: str = "splats") -> WrittenSplats:
    """Write Gaussians as GLB.

    Args:
        path: The file, ``*.glb``.
    """
    shown = turned_y_up(drawable(splats))
    base = np.concatenate([0.5 + SH_C0 * shown.sh0, shown.opacities[:, None]], axis=1)
    attributes: dict[str, NDArray[Any]] = {
        "POSITION": shown.means,
        "COLOR_0": np.rint(np.clip(base, 0, 1) * 255).astype(np.uint8),  # for programs without the extension
        f"{EXTENSION}:ROTATION": shown.quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": np.exp(shown.log_scales),
        f"{EXTENSION}:OPACITY": shown.opacities[:, None],
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": shown.sh0,
    }
    for degree in range(1, shown.sh_degree + 1):
        for index in range(2 * degree + 1):
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{index}"] = shown.shN[:, degree**2 - 1 + index]
    document, binary = _document(attributes, name)
    write_bytes(path, _container(document, binary))
    return WrittenSplats(path, len(shown), len(splats.means) - len(shown))


def _document(attributes: dict[str, NDArray[Any]], name: str) -> tuple[dict[str, Any], bytes]:
    """The JSON part and the binary one."""
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    binary = b""
    for attribute, values in attributes.items():
        data = np.ascontiguousarray(values, np.uint8 if values.dtype == np.uint8 else np.dtype("<f4"))
        accessor: dict[str, Any] = {"bufferView": len(views), "count": len(data), "type": _TYPES[data.shape[1]]}
        accessor["componentType"] = _BYTE if data.dtype == np.uint8 else _FLOAT
        if data.dtype == np.uint8:
            accessor["normalized"] = True
        if attribute == "POSITION" and len(data):
            accessor |= {"min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist()}
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": data.nbytes, "target": _VERTICES})
        accessors.append(accessor)
        binary += data.tobytes()  # all of them are multiples of four bytes long
    splatting = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    }
    primitive = {
        "attributes": {attribute: index for index, attribute in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {EXTENSION: splatting},
    }
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "thermosplat"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": name, "mesh": 0}],
        "meshes": [{"name": name, "primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    return document, binary


def _container(document: dict[str, Any], binary: bytes) -> bytes:
    """A GLB file: a header of 12 bytes, then the two chunks."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
