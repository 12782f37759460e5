"""Fills what the documents take from the code and from `results/`: `python docs/generate.py [--check]`.

Between `<!-- table: NAME -->` and `<!-- end -->` of a page stands what a function here makes; everything
else is written by hand. With --check nothing is written, and a page that is not current ends with exit
code 1.
"""

from __future__ import annotations

import dataclasses
import enum
import inspect
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS), str(DOCS.parent / "src")]

from claims import RULE, paper_markdown  # noqa: E402
from paper_tables import PAPER_TABLES  # noqa: E402
from tables import TABLES, Results, markdown  # noqa: E402

MARK = re.compile(r"(<!-- table: ([\w-]+) -->\n).*?(<!-- end -->)", re.DOTALL)

#: Parts of the API page, in its order: a title, a package, its names.
SHOWN: tuple[tuple[str, str, str], ...] = (
    ("Verbs", "poise", "read write track imitate push inbetween complete dream open_run"),
    ("Results", "poise", "Result Dreamt Run PoiseError"),
    ("Settings", "poise", "TrackConfig ResidualForce Perpetual Inbetween Dream"),
    ("Motion", "poise.motion", "Clip ClipLibrary Skeleton trim resample"),
    ("Motion", "poise.formats", "read_clip write_clip"),
    ("Kinematics", "poise.kinematics", "retarget heal fit_humanoid analytic_ik"),
    ("Kinematics", "poise.kinematics.find_supports", "find_supports"),
    ("Scores", "poise.score", "ScoreCard Help read_score run_episodes simulate RolloutSet Transitions"),
    ("Tasks", "poise.recipes", "build"),
    ("Tasks", "poise.recipes.imitation", "Imitation"),
    ("Environments", "poise.env", "TaskConfig ImitationEnv EnvStep Frame ObsTerm RewardTerm DoneTerm"),
    ("Environments", "poise.env", "GymVectorEnv GymEnv"),
    ("Environments", "poise.env.faces", "RslRlVecEnv"),
    ("Environments", "poise.env.pushes", "Pushes Push"),
    ("Environments", "poise.env.scene_events", "InScene"),
    ("Environments", "poise.env.scene_events", "SetDown Throw"),
    ("Environments", "poise.control", "Compliance Stiffness"),
    ("Learning", "poise.learn", "PPOConfig Until run Trainer"),
    ("Simulation", "poise.sim", "Scene Character Link Touch SceneSim SimConfig make_backend Mechanics"),
)
#: A dataclass with more fields has no signature: its fields are listed.
_MANY = 8
_ADDRESS = re.compile(r" at 0x[0-9a-f]+")


# The command line.


def verbs() -> str:
    """Each verb with its arguments and options; groups that several verbs share stand at the end."""
    from poise.cli.main import VERBS

    groups: dict[str, dict[str, str]] = {}
    parts, users = [], dict[str, list[str]]()
    for verb in (*VERBS, "play_compliant"):
        name = verb.replace("_", " ")
        does, found = _parser(verb)
        groups[name] = found
        parts.append((name, does))
        for title, table in found.items():
            users.setdefault(f"{title}\n{table}", []).append(name)
    shared = {key for key, names in users.items() if len(names) > 1}
    out = []
    for name, does in parts:
        out.append(f"## poise {name}\n\n{does}")
        also = []
        for title, table in groups[name].items():
            if f"{title}\n{table}" in shared:
                also.append(f"[{title}](#{_anchor(title, table, shared)})")
            else:
                out.append(table if title == "options" else f"**{title.capitalize()}**\n\n{table}")
        if also:
            out.append(f"Also: {', '.join(also)}.")
    for key in sorted(shared):
        title, table = key.split("\n", 1)
        heading = _anchor(title, table, shared).replace("-", " ").capitalize()
        out.append(f"## {heading}\n\nOf {', '.join(f'`{n}`' for n in users[key])}.\n\n{table}")
    return "\n\n".join(out)


def _anchor(title: str, table: str, shared: set[str]) -> str:
    """The name of a shared group's heading; groups of one title that differ are numbered."""
    same = sorted(key for key in shared if key.startswith(f"{title}\n"))
    number = same.index(f"{title}\n{table}") + 1
    return re.sub(r"\W+", "-", title) + (f"-{number}" if len(same) > 1 else "")


def _parser(verb: str) -> tuple[str, dict[str, str]]:
    """The summary of a verb, and its groups of options as markdown tables, by title."""
    import tyro

    from poise.cli import parse

    options = parse.options_of(import_module(f"poise.cli.{verb}"))
    with warnings.catch_warnings(), parse.whole_lines(""):
        warnings.simplefilter("ignore")
        made = tyro.extras.get_parser(
            options, prog=f"poise {verb}", config=(tyro.conf.FlagCreatePairsOff,)
        )
    groups: dict[str, str] = {}
    # The groups of argparse's parsers have no public name.
    for group in made._action_groups:  # noqa: SLF001
        actions = group._group_actions  # pyright: ignore[reportPrivateUsage]  # noqa: SLF001
        rows = [row for a in actions if (row := _option(a))]
        if rows:
            title = "options" if group.title in ("positional arguments", "options") else str(group.title)
            head = groups.get(title, "| option | |\n|---|---|")
            groups[title] = "\n".join([head, *rows])
    return parse.summary(options), groups


def _option(action: Any) -> str:
    if action.dest == "help":
        return ""
    names = ", ".join(f"`{n}`" for n in action.option_strings)
    metavar = str(action.metavar or "").strip()
    takes = metavar and action.nargs != 0
    if not names:
        names = f"`{metavar}`"
    elif takes:
        names += f" `{metavar}`"
    text = " ".join(str(action.help or "").split())
    return f"| {names.replace('|', chr(92) + '|')} | {_plain(text)} |"


def _plain(text: str) -> str:
    """Text for a cell of a table: no bar and no bracket that markdown reads."""
    return text.replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")


# The API.


def api() -> str:
    """Signature, docstring and methods of every name in `SHOWN`."""
    out, title = [], ""
    for heading, package, names in SHOWN:
        if heading != title:
            out.append(f"## {heading}")
            title = heading
        for name in names.split():
            out.append(_entry(getattr(import_module(package), name), f"{package}.{name}"))
    return "\n\n".join(out)


def _entry(thing: Any, name: str) -> str:
    short = name.rsplit(".", 1)[1]
    text, fields = _doc(thing), _fields(thing)
    listed = {n for n in fields if re.search(rf"^- `[^`]*\b{n}\b[^`]*`: ", text, re.MULTILINE)}
    if len(fields) > _MANY and listed:
        # Long settings: defaults stand beside what each of them means.
        for n in listed:
            default = fields[n]
            if default:
                text = re.sub(
                    rf"^- `{n}`: ", lambda m, d=default: f"{m[0][:-2]} = `{d}`: ", text, flags=re.M
                )
        rest = [f"`{n} = {d}`" if d else f"`{n}`" for n, d in fields.items() if n not in listed]
        head = f"{short}(...)"
        text += f"\n\nAlso: {', '.join(rest)}." if rest else ""
    else:
        head = _signature(thing, short)
    out = [f"### {name}", f"```text\n{head}\n```", text]
    if inspect.isclass(thing) and not issubclass(thing, Exception | enum.Enum):
        rows = [f"- `{n}`: {_first(m)}" for n, m in _methods(thing)]
        if rows:
            out.append("\n".join(rows))
    return "\n\n".join(part for part in out if part)


def _fields(thing: Any) -> dict[str, str]:
    """The fields of a dataclass, each with its default as text, "" for none."""
    if not dataclasses.is_dataclass(thing):
        return {}
    out = {}
    for field in dataclasses.fields(thing):
        made = field.default_factory is not dataclasses.MISSING
        value = "..." if made else "" if field.default is dataclasses.MISSING else repr(field.default)
        out[field.name] = "..." if len(value) > 40 else value
    return out


def _methods(thing: type) -> Iterator[tuple[str, Any]]:
    for name, member in vars(thing).items():
        inner = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
        if not name.startswith("_") and inspect.isfunction(inner) and inner.__doc__:
            call = name if isinstance(member, property) else f"{name}({_arguments(inner)})"
            yield call, inner


def _arguments(function: Any) -> str:
    names = [
        p.name if p.default is p.empty else f"{p.name}=..."
        for p in inspect.signature(function).parameters.values()
        if p.name not in ("self", "cls")
    ]
    return ", ".join(names)


def _first(thing: Any) -> str:
    """The first sentence of a docstring."""
    text = " ".join(inspect.cleandoc(thing.__doc__ or "").split("\n\n")[0].split())
    return re.split(r"(?<=[.;]) ", text)[0].rstrip(";")


def _signature(thing: Any, name: str) -> str:
    try:
        signature = inspect.signature(thing)
    except (TypeError, ValueError):
        return name
    told = [str(p) for p in signature.parameters.values() if p.name != "self"]
    shown = [_ADDRESS.sub("", text).replace("<factory>", "...") for text in told]
    shown = [re.sub(r"^(\**\w+): '([^']*)'", r"\1: \2", s) for s in shown]
    back = signature.return_annotation
    arrow = (
        f" -> {str(back).strip(chr(39))}" if back not in (inspect.Signature.empty, None, "None") else ""
    )
    line = f"{name}({', '.join(shown)}){arrow}"
    if len(line) <= 96:
        return line
    return f"{name}(\n    " + ",\n    ".join(shown) + f",\n){arrow}"


def _doc(thing: Any) -> str:
    """A docstring in markdown: its sections become lists."""
    out: list[str] = []
    lines = inspect.cleandoc(thing.__doc__ or "").splitlines()
    inside = False
    for line in lines:
        section = re.fullmatch(r"(Args|Attributes|Returns|Raises|Yields):", line)
        item = re.match(r"    (\w[^:]*): (.*)", line) if inside else None
        if section:
            inside = True
            out += ["", f"*{section[1]}*", ""]
        elif item and not line.startswith("     "):
            out.append(f"- `{item[1]}`: {item[2]}")
        elif inside and line.startswith("    "):
            out.append(f"  {line.strip()}")
        else:
            inside = inside and not line.strip()
            out.append(line)
    return "\n".join(out).strip()


# Single tables.


def packages() -> str:
    """The packages from top to bottom, in the order of .importlinter, each as its docstring says."""
    layers = (
        (DOCS.parent / ".importlinter").read_text("utf-8").split("layers =\n", 1)[1].split("\n\n")[0]
    )
    rows = ["| package | what it holds |", "|---|---|"]
    for name in re.findall(r"\w+", layers):
        if not name.startswith("_"):
            module = import_module(f"poise.{name}")
            rows.append(f"| `{name}` | {_plain(_first(module))} |")
    return "\n".join(rows)


def formats() -> str:
    """The formats, from the table of readers and writers."""
    from poise.formats import READERS, WRITERS

    refused = ("ASF", "robot", "OpenPose")
    rows = ["| format | files | read | written |", "|---|---|---|---|"]
    for reader in READERS:
        if reader.name in refused:
            continue
        files = ", ".join(f"`{s}`" for s in reader.suffixes)
        out = ", ".join(f"`{s}`" for s in reader.suffixes if s in WRITERS) or "no"
        if reader.name == "CSV keypoints":
            out = "no"
        named = " where it is named" if reader.asks else ""
        rows.append(f"| {reader.name} | {files} | yes{named} | {out} |")
    return "\n".join(rows)


def commands() -> str:
    """The commands of `/live`, with their fields."""
    from poise.live.protocol import COMMANDS

    rows = ["| type | fields |", "|---|---|"]
    rows += [
        f"| `{kind}` | {', '.join(f'`{f}`' for f in fields)} |" for kind, fields in COMMANDS.items()
    ]
    return "\n".join(rows)


def verdicts() -> str:
    """From when on a figure of a score card is good or fair."""
    from poise.score import THRESHOLDS

    rows = ["| key | good | fair |", "|---|---|---|"]
    rows += [f"| `{key}` | {t.good:g} | {t.fair:g} |" for key, t in THRESHOLDS.items()]
    return "\n".join(rows)


def shipped() -> str:
    """The policies and networks that come along, with the motion that they learned from."""
    from poise.jobs.open import open_run

    results = Results.read()
    rows = ["| what | of | size | learned from |", "|---|---|---|---|"]
    for name, digest in results.ships.items():
        kind = name.partition("-")[0]
        file = next(
            f for f in (DOCS.parent / "src/poise/data").rglob("*.safetensors") if _stem(f) == kind
        )
        told = "see below"
        if kind in ("tracker", "keypoints"):
            about = open_run(None if kind == "tracker" else kind).tracker.about
            told = f"{len(about['clips']):,} clips, {about['samples'] / 1e6:,.0f} million control steps"
        rows.append(f"| `{name}` | `{digest}` | {file.stat().st_size / 1e6:.1f} MB | {told} |")
    return "\n".join(rows)


def generated() -> list[Path]:
    """The documents that have blocks: the README, the pages, and the READMEs of the papers."""
    root = DOCS.parent
    papers = root / "src" / "poise" / "papers"
    return [root / "README.md", *sorted(DOCS.glob("*.md")), *sorted(papers.glob("*/README.md"))]


def _stem(file: Path) -> str:
    return file.parent.name if file.stem == "model" else file.stem


def limits() -> str:
    """The list of `results.md`, for the README."""
    page = (DOCS / "results.md").read_text("utf-8")
    return page.split("## What it does not do\n")[1].split("\n## ")[0].strip()


CODE: dict[str, Callable[[], str]] = {
    "verbs": verbs,
    "api": api,
    "packages": packages,
    "formats": formats,
    "commands": commands,
    "verdicts": verdicts,
    "shipped": shipped,
    "limits": limits,
    "verdict-rule": lambda: RULE,
}


def filled(page: str, results: Results) -> str:
    """A page with every block made anew.

    Raises:
        KeyError: a block has a name that nothing makes, or a table names a row that is not there.
    """

    def block(found: re.Match[str]) -> str:
        name = found[2]
        if name in PAPER_TABLES:
            made = paper_markdown(PAPER_TABLES[name], results)
        else:
            made = markdown(TABLES[name], results) if name in TABLES else CODE[name]()
        return f"{found[1]}\n{made}\n\n{found[3]}"

    return MARK.sub(block, page)


def by_hand(page: str) -> str:
    """A page without what is generated."""
    return MARK.sub("", page)


def main(argv: list[str] | None = None) -> int:
    """Writes the pages, or with --check names those that are not current."""
    check = "--check" in (sys.argv[1:] if argv is None else argv)
    results, stale = Results.read(), []
    for page in generated():
        before = page.read_text("utf-8")
        after = filled(before, results)
        if after != before:
            stale.append(page.relative_to(DOCS.parent).as_posix())
            if not check:
                page.write_text(after, "utf-8")
    if stale:
        told = "not current, run python docs/generate.py" if check else "written"
        sys.stdout.write(f"{', '.join(stale)}: {told}\n")
    return int(check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
