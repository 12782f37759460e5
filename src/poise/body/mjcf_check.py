"""MJCF from strangers: what a file may name and ask for, before MuJoCo opens it."""

from __future__ import annotations

import math
import re
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers.expat import ExpatError

from poise.errors import PoiseError
from poise.motion.io.text import check_file, shown

#: Bytes of all files, files, elements of each of them, and how deep they may lie.
MOST_BYTES, MOST_FILES, MOST_ELEMENTS, MOST_DEEP = 64 << 20, 200, 50_000, 200
#: What one element may make: pixels, points of a height field, copies, numbers of a size.
MOST_MADE = 1 << 24
MOST_COPIES = 1000


def check_mjcf(path: Path) -> int:
    """Refuses a file that opens others outside its folder, loads plug-ins or asks for huge things.

    Returns:
        bytes of all files of which it is made.
    """
    folder = path.resolve().parent
    waiting, roots, dirs = [path], dict[Path, ElementTree.Element](), {""}
    while waiting:
        file = waiting.pop()
        if file.resolve() in roots:
            continue
        if len(roots) == MOST_FILES:
            raise PoiseError(f"it is made of more than {MOST_FILES} files", path)
        check_file(file, MOST_BYTES)
        root = roots[file.resolve()] = _tree(file)
        for element in root.iter():
            _check_element(element, file)
            named = element.get("file")
            if element.tag in ("include", "model") and named is not None:
                waiting.append(_inside(named, "", file, folder))
            if element.tag == "compiler":
                dirs |= {element.get(k, "") for k in ("meshdir", "texturedir", "assetdir")}
    assets = set[Path]()
    for root in roots.values():
        for named in {x.get("file", "") for x in root.iter()} - {""}:
            assets |= {_inside(named, inner, path, folder) for inner in dirs}
    size = sum(file.stat().st_size for file in assets | set(roots) if file.is_file())
    if size > MOST_BYTES:
        raise PoiseError(f"its files have {size / 1e6:.0f} MB, more than {MOST_BYTES / 1e6:.0f}", path)
    return size


def _inside(named: str, inner: str, file: Path, folder: Path) -> Path:
    """A file that is named, refused where it lies outside the folder of the body."""
    try:
        found = (folder / inner / named).resolve()
        outside = not found.is_relative_to(folder)
    except (ValueError, OSError, RuntimeError):
        found, outside = folder, True
    if outside:
        raise PoiseError(
            f"it names a file outside its folder ({shown(Path(inner) / named)})",
            file,
            "Copy what it needs beside it and name it from there",
        )
    return found


def _check_element(element: ElementTree.Element, file: Path) -> None:
    """Refuses plug-ins and elements that make more than a body needs."""
    if element.tag in ("extension", "plugin"):
        raise PoiseError("it loads plug-ins, which can run any code", file, "Leave them out")
    for name, most in (("count", MOST_COPIES), ("nkey", MOST_COPIES), ("nuserdata", MOST_MADE)):
        if element.tag in ("replicate", "composite", "size") or name == "count":
            _bound(element, (name,), most, file)
    _bound(element, ("nrow", "ncol"), MOST_MADE, file)
    _bound(element, ("width", "height"), MOST_MADE, file)


def _bound(element: ElementTree.Element, names: tuple[str, ...], most: int, file: Path) -> None:
    made = 1.0
    for word in " ".join(element.get(n, "") for n in names).split():
        try:
            made *= abs(float(word))
        except ValueError:
            return
    if not (math.isfinite(made) and made <= most):
        what = f"its <{shown(element.tag)[1:-1]}> makes {made:.3g} with {' and '.join(names)}"
        raise PoiseError(f"{what}, more than the {most} allowed", file, "Leave it out")


def _tree(file: Path) -> ElementTree.Element:
    depth, count, root = 0, 0, None
    try:
        text = file.read_bytes()
        if re.search(rb"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
            raise PoiseError("it declares entities, which no body needs", file)
        for event, element in ElementTree.iterparse(file, ("start", "end")):
            depth += 1 if event == "start" else -1
            count, root = count + 1, element if root is None else root
            if depth > MOST_DEEP:
                raise PoiseError(f"its elements lie more than {MOST_DEEP} deep", file)
            if count > 2 * MOST_ELEMENTS:
                raise PoiseError(f"it has more than {MOST_ELEMENTS} elements", file)
    except (ElementTree.ParseError, ExpatError, ValueError, LookupError, OSError) as problem:
        raise PoiseError(f"MuJoCo cannot read it: {shown(problem)}", file) from None
    if root is None:
        raise PoiseError("it is empty", file)
    return root
