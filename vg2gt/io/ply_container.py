"""The PLY container: header and tables of elements. Damaged files raise ``FormatError``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vg2gt.io.errors import FormatError
from vg2gt.io.files import regular

_TYPES = {
    **dict.fromkeys(("char", "int8"), "<i1"),
    **dict.fromkeys(("uchar", "uint8"), "<u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}
_NAMES = {np.dtype("<f4"): "float", np.dtype("<f8"): "double", np.dtype("u1"): "uchar", np.dtype("<u4"): "uint"}
_HEADER_LIMIT = 1 << 16
_END = b"end_header"
_ENCODINGS = ("binary_little_endian", "binary_big_endian", "ascii")


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[tuple[str, str], ...]
    has_list: bool


def ply_content(elements: Mapping[str, NDArray], comments: Sequence[str] = ()) -> bytes:
    """Encodes structured arrays as a binary little-endian file, in the order of elements and fields."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    for element, table in elements.items():
        lines += [f"element {element} {len(table)}"]
        lines += [f"property {_NAMES[table.dtype[name]]} {name}" for name in table.dtype.names or ()]
    return "\n".join([*lines, "end_header", ""]).encode() + b"".join(table.tobytes() for table in elements.values())


def read_vertices(path: Path) -> NDArray:
    """Reads the ``vertex`` element as a structured array; later elements are ignored."""
    return read_elements(path, "vertex")["vertex"]


def read_elements(path: Path, *wanted: str) -> dict[str, NDArray]:
    """Reads elements of a file as little-endian structured arrays, by name; missing ones are left out."""
    data = regular(path).read_bytes()
    encoding, elements, start = _header(path, data)
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise FormatError(f"{path}: no element vertex, only {', '.join(names) or 'none'}; this is not a file of points")
    found = [name for name in wanted if name in names]
    return {name: _read_element(path, data, start, encoding, elements, names.index(name)) for name in found}


def _read_element(path: Path, data: bytes, start: int, encoding: str, elements: list[_Element], number: int) -> NDArray:
    before, vertex = elements[:number], elements[number]
    if vertex.has_list or any(element.has_list for element in before):
        raise FormatError(f"{path}: a list property in or before the vertices; write the file with the vertices first")
    if not vertex.properties:
        raise FormatError(f"{path}: the vertices have no properties; the file is damaged")
    if encoding == "ascii":
        return _ascii_table(path, data[start:], before, vertex)
    dtype = np.dtype(list(vertex.properties))
    offset = start + sum(element.count * np.dtype(list(element.properties)).itemsize for element in before)
    needed, left = vertex.count * dtype.itemsize, max(0, len(data) - offset)
    if needed > left:
        raise FormatError(
            f"{path}, byte {offset}: {vertex.count} vertices of {dtype.itemsize} bytes need {needed} bytes, {left} are "
            "left; the file is truncated or damaged"
        )
    if encoding == "binary_big_endian":
        return np.frombuffer(data, dtype.newbyteorder(">"), vertex.count, offset).astype(dtype)
    return np.frombuffer(data, dtype, vertex.count, offset)


def read_comments(path: Path) -> list[str]:
    """Reads the header's comments, without the keyword."""
    with regular(path).open("rb") as file:
        head = file.read(_HEADER_LIMIT)
    lines = head[: max(0, head.find(_END))].decode("latin-1").splitlines()
    return [line.removeprefix("comment").strip() for line in lines if line.startswith("comment ")]


def _ascii_table(path: Path, body: bytes, before: list[_Element], vertex: _Element) -> NDArray:
    lines = body.split(b"\n")[sum(element.count for element in before) :]
    if vertex.count > len(lines):
        raise FormatError(
            f"{path}: the header gives {vertex.count} vertices, but {len(lines)} lines follow; the file is truncated"
        )
    table = np.empty(vertex.count, list(vertex.properties))
    columns = [line.split() for line in lines[: vertex.count]]
    width = len(vertex.properties)
    short = next((i for i, column in enumerate(columns) if len(column) != width), None)
    if short is not None:
        raise FormatError(f"{path}: vertex {short} has {len(columns[short])} numbers, expected {width}")
    try:
        for i, (name, _) in enumerate(vertex.properties):
            table[name] = np.array([column[i] for column in columns]).astype(table.dtype[name])
    except (ValueError, OverflowError) as error:
        raise FormatError(f"{path}: a vertex has a value that is not a number ({error}); it is damaged") from error
    return table


def _header(path: Path, data: bytes) -> tuple[str, list[_Element], int]:
    """Encoding, elements and the byte at which the body begins."""
    at = data.find(_END, 0, _HEADER_LIMIT)
    newline = data.find(b"\n", at, at + len(_END) + 3)
    if not data.startswith(b"ply") or at < 0 or newline < 0:
        raise FormatError(f"{path}: not a PLY file, expected a header from 'ply' to 'end_header'")
    lines = [line.split() for line in data[:at].decode("latin-1").splitlines()]
    encoding, elements = None, []
    for number, words in enumerate(lines, 1):
        if not words or words[0] in ("ply", "comment", "obj_info"):
            continue
        place = f"{path}, line {number} of the header"
        if words[0] == "format" and len(words) == 3 and words[1] in _ENCODINGS:
            encoding = words[1]
        elif words[0] == "format":
            raise FormatError(f"{place}: unsupported format {' '.join(words[1:])}; supported: {', '.join(_ENCODINGS)}")
        elif words[0] == "element" and len(words) == 3 and words[2].isascii() and words[2].isdigit():
            if len(words[2]) > 18:
                raise FormatError(f"{place}: {words[2][:20]}... elements; the file is damaged")
            elements.append(_Element(words[1], int(words[2]), (), False))
        elif words[0] == "property" and elements:
            elements[-1] = _with_property(place, elements[-1], words)
        else:
            raise FormatError(f"{place}: unexpected {' '.join(words)[:60]!r}; the file is damaged")
    if encoding is None:
        raise FormatError(f"{path}: the header has no line 'format'; the file is damaged")
    return encoding, elements, newline + 1


def _with_property(place: str, element: _Element, words: list[str]) -> _Element:
    if len(words) == 5 and words[1] == "list":
        return _Element(element.name, element.count, element.properties, True)
    if len(words) != 3 or words[1] not in _TYPES:
        raise FormatError(f"{place}: unexpected {' '.join(words)[:60]!r}, expected 'property TYPE NAME'")
    if words[2] in dict(element.properties):
        raise FormatError(f"{place}: property {words[2]} occurs twice; the file is damaged")
    return _Element(element.name, element.count, (*element.properties, (words[2], _TYPES[words[1]])), element.has_list)
