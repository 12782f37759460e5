"""Counts the concepts of a source tree: sizes, names, settings, cycles, what nothing uses.

    python benchmarks/structure.py [SRC]          # by default src/poise; prints JSON
    python benchmarks/structure.py --before db2811f -o results/structure.csv     # that commit and HEAD

| key | what it counts |
|---|---|
| code_lines, logical_lines | without blanks, comments, docstrings; statements without docstrings |
| public_names | functions, classes and constants of modules that do not begin with an underscore |
| exported_names | names in the `__all__` of packages |
| settings, settings_fields | dataclasses whose fields all have defaults, and those fields |
| numeric_constants | names at the top of modules that are numbers, or tuples of numbers |
| persons | "who", "whose", "somebody" and the like, in comments, docstrings and other strings |
| cycles | groups of modules that import each other, also inside functions, without `TYPE_CHECKING` |
| engine_lines, engine_settings_fields | the same without `papers` |
| track_files, track_depth | modules that `poise track` imports, and the longest chain of them |
| goal_methods, plugin_methods | public methods of the classes `Goal` and `Plugin` of `env` |
| repeated_* | names of files and of classes that stand in more than one place |
| verb_file_names | names that only a verb's command line and its job share: `{cli,jobs}/push.py` |
| unused_* | public ones whose name stands nowhere but in their definition and in `__init__` files |

A verb's command line is a file of `cli` that has a function `run`; its pair with a job is a convention,
and `repeated_file_names` leaves it out. Names are compared as words: what shares its name with something
used counts as used.
"""

from __future__ import annotations

import argparse
import ast
import csv
import io
import json
import re
import statistics
import subprocess
import tarfile
import tempfile
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
Function = ast.FunctionDef | ast.AsyncFunctionDef
PERSONS = re.compile(r"\b(who|whose|whoever|whom|somebody|nobody)\b", re.IGNORECASE)


def is_docstring(node: ast.AST) -> bool:
    """A statement that is nothing but a string: a docstring, or one of an attribute."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def code_lines(text: str, tree: ast.Module) -> int:
    """Lines that hold code."""
    apart = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
    apart |= {tokenize.ENDMARKER, tokenize.ENCODING}
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in apart:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(tree):
        if is_docstring(node):
            lines -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))  # type: ignore[attr-defined]
    return len(lines)


def persons(text: str) -> Counter[str]:
    """Words for persons in comments and strings."""
    kinds = {tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}
    found: Counter[str] = Counter()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in kinds:
            found.update(word.lower() for word in PERSONS.findall(token.string))
    return found


def is_number(node: ast.expr | None) -> bool:
    """A number, an expression of numbers, or a tuple of them."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float) and not isinstance(node.value, bool)
    if isinstance(node, ast.UnaryOp):
        return is_number(node.operand)
    if isinstance(node, ast.BinOp):
        return is_number(node.left) and is_number(node.right)
    if isinstance(node, ast.Tuple | ast.List):
        return bool(node.elts) and all(map(is_number, node.elts))
    return False


def constants(tree: ast.Module) -> Iterator[tuple[str, bool]]:
    """Names that are assigned at the top of a module, and whether they are numbers."""
    for node in tree.body:
        if isinstance(node, ast.Assign):
            pairs = [(t, node.value) for t in node.targets]
        elif isinstance(node, ast.AnnAssign):
            pairs = [(node.target, node.value)]
        else:
            continue
        for target, value in pairs:
            names = target.elts if isinstance(target, ast.Tuple) else [target]
            values = (
                value.elts
                if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)
                else [value] * len(names)
            )
            for name, one in zip(names, values, strict=False):
                if isinstance(name, ast.Name):
                    yield name.id, is_number(one)


def is_dataclass(node: ast.ClassDef) -> bool:
    """Decorated by `dataclass`."""
    names = {ast.unparse(d.func if isinstance(d, ast.Call) else d) for d in node.decorator_list}
    return bool(names & {"dataclass", "dataclasses.dataclass"})


def fields(node: ast.ClassDef) -> list[ast.AnnAssign]:
    """The annotated fields of a class."""
    found = [n for n in node.body if isinstance(n, ast.AnnAssign)]
    return [n for n in found if not ast.unparse(n.annotation).startswith(("ClassVar", "KW_ONLY"))]


class Imports(ast.NodeVisitor):
    """Modules of the package that a module imports: at its top, and anywhere."""

    def __init__(self, module: str, is_package: bool, modules: set[str]):
        self.package = module.split(".") if is_package else module.split(".")[:-1]
        self.modules, self.depth = modules, 0
        self.top: set[str] = set()
        self.all: set[str] = set()

    def visit_If(self, node: ast.If) -> None:
        if "TYPE_CHECKING" in ast.unparse(node.test):
            for child in node.orelse:
                self.visit(child)
        else:
            self.generic_visit(node)

    def _inside(self, node: Function) -> None:
        self.depth += 1
        self.generic_visit(node)
        self.depth -= 1

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        self._inside(node)

    def visit_AsyncFunctionDef(self, node: ast.AsyncFunctionDef) -> None:
        self._inside(node)

    def visit_Import(self, node: ast.Import) -> None:
        for alias in node.names:
            self._add(alias.name)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        above = self.package[: len(self.package) - node.level + 1] if node.level else []
        base = ".".join([*above, *([node.module] if node.module else [])])
        for alias in node.names:
            # A submodule, or a name of the module.
            self._add(f"{base}.{alias.name}" if f"{base}.{alias.name}" in self.modules else base)

    def _add(self, name: str) -> None:
        if name in self.modules:
            self.all.add(name)
            if not self.depth:
                self.top.add(name)


def cycles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Groups of more than one module that reach each other (Tarjan 1972), or one that imports itself."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(v: str) -> None:
        index[v] = low[v] = len(index)
        stack.append(v)
        for w in sorted(graph[v]):
            if w not in index:
                visit(w)
                low[v] = min(low[v], low[w])
            elif w in stack:
                low[v] = min(low[v], index[w])
        if low[v] == index[v]:
            at = stack.index(v)
            group, stack[at:] = stack[at:], []
            if len(group) > 1 or v in graph[v]:
                found.append(sorted(group))

    for v in sorted(graph):
        if v not in index:
            visit(v)
    return sorted(found)


def reach(graph: dict[str, set[str]], start: str) -> tuple[int, int]:
    """Modules that are imported from `start` on, itself among them, and the longest chain of them."""
    depth: dict[str, int] = {}

    def visit(v: str) -> int:
        if v not in depth:
            depth[v] = 0  # Of a cycle nothing is counted twice.
            depth[v] = 1 + max((visit(w) for w in graph[v] - {v}), default=0)
        return depth[v]

    return (visit(start), len(depth))[::-1] if start in graph else (0, 0)


def words(tree: ast.Module, imports: bool) -> Counter[str]:
    """How often each name is used in a module; with `imports` those that are imported as well."""
    used: Counter[str] = Counter()
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            used[node.id] += 1
        elif isinstance(node, ast.Attribute):
            used[node.attr] += 1
        elif isinstance(node, ast.ImportFrom | ast.Import) and imports:
            used.update(alias.name for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("getattr", "attrgetter"):
            used.update(
                a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)
            )
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            # Tables of names and import paths: "poise.learn:PPOConfig".
            used.update(re.findall(r"^poise[\w.]*:(\w+)$", node.value))
    return used


def imports(
    source: Path, trees: dict[Path, ast.Module]
) -> tuple[dict[str, set[str]], dict[str, set[str]]]:
    """Modules of the package in `source` that each of them imports: at its top, and anywhere."""
    names = {p: ".".join((source.name, *p.relative_to(source).with_suffix("").parts)) for p in trees}
    names = {p: n.removesuffix(".__init__") for p, n in names.items()}
    modules, top, everywhere = set(names.values()), {}, {}
    for p, tree in trees.items():
        found = Imports(names[p], p.name == "__init__.py", modules)
        found.visit(tree)
        top[names[p]], everywhere[names[p]] = found.top, found.all
    return top, everywhere


def repeated_files(
    source: Path, trees: dict[Path, ast.Module]
) -> tuple[dict[str, list[str]], list[str]]:
    """Names that several files have, with these files; and those that a verb and its job alone share."""
    found: dict[str, list[str]] = {}
    for p in trees:
        if p.name != "__init__.py":
            found.setdefault(p.stem, []).append(str(p.relative_to(source)))
    verbs = {
        p.stem
        for p, tree in trees.items()
        if p.parent == source / "cli" and "run" in {getattr(n, "name", "") for n in tree.body}
    }
    repeated = {name: files for name, files in found.items() if len(files) > 1}
    pairs = [k for k in repeated if k in verbs and repeated[k] == [f"cli/{k}.py", f"jobs/{k}.py"]]
    return {k: v for k, v in repeated.items() if k not in pairs}, pairs


def structure(source: Path) -> dict[str, Any]:
    """All counts of the package in a folder."""
    paths = sorted(source.rglob("*.py"))
    texts = {p: p.read_text(encoding="utf-8") for p in paths}
    trees = {p: ast.parse(text) for p, text in texts.items()}
    top, everywhere = imports(source, trees)
    used: Counter[str] = Counter()
    for p in paths:
        used += words(trees[p], imports=p.name != "__init__.py")
    counts: Counter[str] = Counter()
    unused: dict[str, list[str]] = {"functions": [], "classes": [], "methods": []}
    named: Counter[str] = Counter()
    hooks: Counter[str] = Counter()
    repeated, verbs = repeated_files(source, trees)
    folk: Counter[str] = Counter()
    by_folder: Counter[str] = Counter()
    for p in paths:
        tree = trees[p]
        at = f"{p.relative_to(source)}:"
        folk += persons(texts[p])
        by_folder[p.relative_to(source).parts[0]] += len(texts[p].splitlines())
        counts["code_lines"] += code_lines(texts[p], tree)
        counts["logical_lines"] += sum(
            isinstance(n, ast.stmt) and not is_docstring(n) for n in ast.walk(tree)
        )
        for name, number in constants(tree):
            counts["public_constants"] += not name.startswith("_")
            counts["numeric_constants"] += number
        exported = [
            n.value
            for n in tree.body
            if isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "__all__"
        ]
        if exported and p.name == "__init__.py":
            counts["exported_names"] += len(ast.literal_eval(exported[0]))
        for node in tree.body:
            if isinstance(node, Function) and not node.name.startswith("_"):
                counts["public_functions"] += 1
                unused["functions"] += [at + node.name] * (not used[node.name])
            elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                counts["public_classes"] += 1
                unused["classes"] += [at + node.name] * (not used[node.name])
        for node in ast.walk(tree):
            if not isinstance(node, ast.ClassDef):
                counts["functions"] += isinstance(node, Function)
                continue
            named[node.name] += 1
            counts["options_classes"] += node.name == "Options"
            if node.name in ("Goal", "Plugin") and at.startswith("env/"):
                public = [n for n in node.body if isinstance(n, Function) and n.name[0] != "_"]
                hooks[node.name] += len(public)
            for method in node.body:
                if isinstance(method, Function) and not method.name.startswith(("_", "visit_")):
                    unused["methods"] += [f"{at}{node.name}.{method.name}"] * (not used[method.name])
            if is_dataclass(node):
                counts["dataclasses"] += 1
                own = fields(node)
                if own and all(f.value is not None for f in own):
                    counts["settings"] += 1
                    counts["settings_fields"] += len(own)
                    counts["engine_settings_fields"] += len(own) * (not at.startswith("papers/"))
    lengths = {str(p.relative_to(source)): len(t.splitlines()) for p, t in texts.items()}
    longest = max(lengths, key=lambda k: lengths[k])
    track_files, track_depth = reach(everywhere, f"{source.name}.cli.track")
    public = sum(counts[f"public_{k}"] for k in ("functions", "classes", "constants"))
    return {
        "files": len(paths),
        "lines": sum(lengths.values()),
        "engine_lines": sum(lengths.values()) - by_folder["papers"],
        "lines_by_folder": dict(sorted(by_folder.items())),
        "code_lines": counts["code_lines"],
        "logical_lines": counts["logical_lines"],
        "median_file": statistics.median(lengths.values()),
        "longest_file": {"file": longest, "lines": lengths[longest]},
        "public_names": public,
        **{
            k: counts[k]
            for k in ("public_functions", "public_classes", "public_constants", "exported_names")
        },
        "classes": named.total(),
        **{k: counts[k] for k in ("functions", "dataclasses", "settings", "settings_fields")},
        "engine_settings_fields": counts["engine_settings_fields"],
        "track_files": track_files,
        "track_depth": track_depth,
        "goal_methods": hooks["Goal"],
        "plugin_methods": hooks["Plugin"],
        "numeric_constants": counts["numeric_constants"],
        "options_classes": counts["options_classes"],
        "repeated_file_names": len(repeated),
        "repeated_files": repeated,
        "verb_file_names": verbs,
        "repeated_class_names": sum(n > 1 for k, n in named.items() if k[0] != "_" and k != "Options"),
        "who_whose": folk["who"] + folk["whose"],
        "persons": dict(sorted(folk.items())),
        "cycles_at_the_top": cycles(top),
        "cycles": cycles(everywhere),
        **{f"unused_{k}": len(v) for k, v in unused.items()},
        "unused": unused,
    }


#: The counts that `results/structure.csv` has of a tree before and after.
COMPARED = (
    *("files", "lines", "engine_lines", "classes", "dataclasses", "settings_fields"),
    *("engine_settings_fields", "options_classes", "track_files", "track_depth", "goal_methods"),
    *("plugin_methods", "repeated_file_names", "repeated_class_names", "cycles"),
)


def at_commit(commit: str) -> dict[str, Any]:
    """The counts of the tree of a commit."""
    tree = ["git", "archive", commit, "src"]
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(tree, cwd=ROOT, check=True, capture_output=True).stdout
        with tarfile.open(fileobj=io.BytesIO(archive)) as files:
            files.extractall(folder, filter="data")
        return structure(Path(folder) / "src/poise")


def rows(commits: dict[str, str], command: str) -> Iterator[dict[str, Any]]:
    """Rows of `results/structure.csv`. commits: by what their trees are called."""
    for subject, commit in commits.items():
        counts = at_commit(commit)
        for metric in COMPARED:
            value = counts[metric]
            value = len(value) if isinstance(value, list) else value
            row = {"subject": subject, "metric": metric, "value": value, "n": 1, "commit": commit}
            yield row | {"command": command}


def main() -> None:
    """Prints the counts of the folder that is named, or writes those of two commits."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path, nargs="?", default=ROOT / "src/poise")
    parser.add_argument("--before", metavar="COMMIT")
    parser.add_argument("--after", metavar="COMMIT", default="HEAD")
    parser.add_argument("-o", "--out", type=Path, default=ROOT / "results/structure.csv")
    a = parser.parse_args()
    if a.before is None:
        source = a.source / "poise" if (a.source / "poise").is_dir() else a.source
        print(json.dumps(structure(source.resolve()), indent=2))
        return
    short = ["git", "rev-parse", "--short", a.after]
    after = subprocess.run(short, cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()
    columns = ["subject", "metric", "value", "spread", "n", "seeds", "policy", "commit", "command"]
    command = f"python benchmarks/structure.py --before {a.before}"
    with a.out.open("w", newline="", encoding="utf-8") as file:
        write = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        write.writeheader()
        write.writerows(rows({"before": a.before, "after": after}, command))


if __name__ == "__main__":
    main()
