"""The page of `poise open` in Chromium with the jobs themselves: a motion comes in and goes out."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from chromium import CHROMIUM, Page, opened

from poise.cli.open import HEAVY, PRELOAD, look, rests, work
from poise.formats import read_clip, write_clip
from poise.live.admission import Guard
from poise.live.open.actions import ACTIONS
from poise.live.open.open_server import OpenServer, Runs
from poise.live.open.project import Project
from test_docs import WALK

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine"),
    pytest.mark.timeout(900),
]
#: The motion that is shown, and what is known of it.
NOW = "(poiseOpen.state.project.takes.find(t => t.id === poiseOpen.state.current) || {name: ''})"
READY = (
    "window.poiseOpen && poiseOpen.state.project && poiseOpen.state.motion && poiseOpen.state.judged"
    f" && {NOW}"
)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OpenServer]:
    folder = tmp_path_factory.mktemp("animator") / "project"
    out = OpenServer(
        Project(folder), Guard("127.0.0.1", 0, "word"), Runs(work, look, rests, PRELOAD, HEAVY)
    )
    yield out
    out.close()


@pytest.fixture(scope="module")
def page(server: OpenServer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with opened(server.url, tmp_path_factory.mktemp("profile")) as one:
        # Small, since pictures are drawn without a GPU.
        one.size(480, 400)
        one.until("window.poiseOpen && poiseOpen.state.project", 60)
        yield one
        assert one.errors == []


def drop(page: Page, *files: Path) -> None:
    """Chooses files, as a drop does."""
    root = page.call("DOM.getDocument")["root"]["nodeId"]
    node = page.call("DOM.querySelector", nodeId=root, selector="#files")["nodeId"]
    page.call("DOM.setFileInputFiles", files=[str(f) for f in files], nodeId=node)


def shown(page: Page, name: str, seconds: float = 400.0) -> None:
    """Waits for a motion, and that it is looked at."""
    page.until(f"{READY}.name === {name!r} && !{NOW}.looking", seconds)


def do(page: Page, action: str, settings: str = "") -> None:
    """Presses a button, after its settings."""
    page.js(f"document.querySelector('#action-{action}').open = true")
    page.js(f"{{ const form = poiseOpen.forms().get('{action}'); {settings} }}")
    page.js(f"document.querySelector('#action-{action} button.main:last-of-type').click()")


def choose(page: Page, name: str) -> None:
    """Shows another motion."""
    number = page.js(f"poiseOpen.state.project.takes.find(t => t.name === {name!r}).id")
    page.js(f"document.querySelector('#takes [data-take=\"{number}\"]').click()")
    shown(page, name)


def press(page: Page, key: str, modifiers: int = 0) -> None:
    for kind in ("keyDown", "keyUp"):
        number = 9 if key == "Tab" else 0
        more = {"windowsVirtualKeyCode": number, "code": key} if number else {}
        page.call("Input.dispatchKeyEvent", type=kind, key=key, modifiers=modifiers, **more)


def test_a_motion_is_mended_gets_a_body_is_pushed_and_goes_out(
    server: OpenServer, page: Page, tmp_path: Path
) -> None:
    walk = read_clip(WALK)
    slid = walk.root_pos.copy()
    slid[:, :2] += np.linspace(0, 1, walk.frames)[:, None] * [0.0, 0.9]
    source = tmp_path / "video.bvh"
    write_clip(walk.replaced(root_pos=slid), source)
    before = source.read_bytes()
    drop(page, source)
    shown(page, "video")
    kinds = page.js("[...new Set(poiseOpen.state.judged.faults.map(f => f.kind))]")
    assert "foot slide" in kinds
    # A mark leads to the frame, and marks its range.
    page.js(
        "[...document.querySelectorAll('#faults button')].find(b => b.title.includes('slides')).click()"
    )
    fault = page.js("poiseOpen.state.judged.faults[poiseOpen.state.fault]")
    assert page.js("poiseOpen.state.frame") == fault["start"]
    assert page.js("poiseOpen.state.joint") == fault["joint"]
    do(page, "mend")
    shown(page, "video mended")
    assert len(page.js("poiseOpen.state.judged.faults")) < 4
    assert "faults before" in page.js("document.querySelector('#says').innerText")
    # Undo shows what came in, and does it again.
    press(page, "z", 2)
    shown(page, "video")
    press(page, "z", 2 | 8)
    shown(page, "video mended")
    do(page, "body", "form.set('controller', 'policy'); form.set('pins', [['left_hand', 40, 50]])")
    shown(page, "video mended with a body")
    assert "Nothing helped the body: 0 N." in page.js("document.querySelector('#says').innerText")
    choose(page, "video mended")
    page.js("poiseOpen.seek(33)")
    do(page, "push", "form.set('force', 60); form.set('seconds', 0.2); form.set('controller', 'policy')")
    shown(page, "video mended pushed")
    assert "--at chest --force 60 --from 1.1 --seconds 0.2" in page.js(f"{NOW}.line")
    assert page.js("poiseOpen.state.compare") == page.js(f"{NOW}.parent")
    page.js("document.getElementById('export').click()")
    page.until("document.getElementById('toast').textContent.includes('lies in')", 60)
    out = server.project.folder / "exports" / "video mended pushed.bvh"
    take = server.project.takes[page.js("poiseOpen.state.current")]
    made, again = (read_clip(p, unit_m=0.01, up_axis="Y") for p in (server.project.path(take), out))
    assert again.skeleton.names == walk.skeleton.names and again.frames == walk.frames
    np.testing.assert_allclose(again.positions(), made.positions(), atol=1e-4)
    assert source.read_bytes() == before
    python = os.environ.get("POISE_BPY_PYTHON") or sys.executable
    if "POISE_BPY_PYTHON" in os.environ or importlib.util.find_spec("bpy"):
        script = (
            "import bpy, sys; bpy.ops.import_anim.bvh(filepath=sys.argv[1], global_scale=0.01); "
            + (
                "o = bpy.context.object; bpy.context.scene.frame_set(31); "
                "print(*(o.matrix_world @ o.pose.bones['Head'].matrix).translation)"
            )
        )
        told = subprocess.run(
            [python, "-c", script, str(out)], capture_output=True, text=True, check=True, timeout=240
        )
        shown_there = [float(x) for x in told.stdout.split("\n")[-2].split()]
        head = again.positions()[30, walk.skeleton.names.index("Head")]
        np.testing.assert_allclose(shown_there, head, atol=1e-3)


def test_keys_between_and_the_stage_while_a_job_runs(server: OpenServer, page: Page) -> None:
    """Frames that stay are marked by hand, the page goes on drawing, and Stop stops."""
    choose(page, "video mended")
    press(page, "k")
    for frame in (0, 40, 85):
        page.js(f"poiseOpen.seek({frame})")
        press(page, "s")
    assert page.js("poiseOpen.forms().get('between').values.keyframes") == [0, 40, 85]
    said = "document.querySelector('#action-between .line').textContent"
    assert "--keyframes 0,40,85" in page.until(f"{said}.includes('85') && {said}", 20)
    do(page, "between")
    page.until("document.body.dataset.busy === 'yes'")
    # A picture takes few calls, whatever the number of bones.
    assert 0 < page.js("poiseOpen.state.calls") < 20
    # The stage shows what is simulated so far, and time goes along.
    page.until("poiseOpen.state.made && poiseOpen.state.made[1] > 4", 200)
    page.until("poiseOpen.state.frame > 2 && poiseOpen.state.frame < 85", 20)
    assert "Between keys, so far" in page.js("document.getElementById('legend').textContent")
    press(page, " ")
    page.until("poiseOpen.state.playing")
    time.sleep(2.0)
    moved = page.js("poiseOpen.state.frame")
    page.until(f"poiseOpen.state.frame !== {moved}", 5)
    page.until("[...document.querySelectorAll('#jobs button')].some(b => b.textContent === 'Stop')", 60)
    page.js("document.querySelector('#jobs button').click()")
    page.until("document.body.dataset.busy === 'no'", 60)
    assert not [t for t in server.project.takes.values() if t.action == "between"]
    page.until("poiseOpen.state.made === null")
    press(page, "k")


def test_a_file_that_needs_a_word_asks_for_it(page: Page, tmp_path: Path) -> None:
    """GVHMR's result is pickled and states no rate: a press for each, and it is there to be saved."""
    flat = {"global_orient": torch.zeros(40, 3), "body_pose": torch.zeros(40, 63)}
    told = {**flat, "transl": torch.zeros(40, 3), "betas": torch.zeros(40, 10)}
    torch.save({"smpl_params_global": told, "smpl_params_incam": told}, tmp_path / "hmr4d_results.pt")
    drop(page, tmp_path / "hmr4d_results.pt")
    for said in ("no code in it runs", "frames per second"):
        page.until(f"document.getElementById('problem').innerText.includes('{said}')", 60)
        page.js("document.querySelector('#problem button.main').click()")
    shown(page, "hmr4d_results")
    assert page.js("document.getElementById('problem').hidden && poiseOpen.state.motion.fps") == 30
    assert page.js("document.getElementById('format').value") == ".bvh"


#: Of what has the focus: its part of the page, a word on it, its edges, and whether a ring shows it.
FOCUS = """(() => { const e = document.activeElement, b = e.getBoundingClientRect();
    const part = e.closest('header, nav, main, aside, footer');
    return [part ? part.tagName : '', e.id || e.textContent.trim(), b.left, b.top, b.right, b.bottom,
            getComputedStyle(e).outlineStyle]; })()"""
#: Roles of what somebody can do something with.
CONTROLS = {
    *("button", "textbox", "spinbutton", "checkbox", "combobox", "slider", "link", "application"),
    *("DisclosureTriangle", "progressbar", "Canvas"),
}


def test_names_and_places_of_the_controls(page: Page) -> None:
    """Each control of each form has a name for screen readers, is reached by Tab in the order of the
    page, with a ring, and lies within the window; no choice is cut off."""
    choose(page, "video")
    page.size(1280, 720)
    page.call("Accessibility.enable")
    for action in ACTIONS:
        page.js(f"document.querySelector('#action-{action}').open = true")
        page.js(
            "document.querySelectorAll('aside details details, nav details').forEach(d => d.open = true)"
        )
        page.js(
            f"document.querySelectorAll('#action-{action} .row:not(.box):last-child button').forEach("
            "b => { if (/add|seat|floor|state/i.test(b.textContent)) b.click(); })"
        )
        tree = page.call("Accessibility.getFullAXTree")["nodes"]
        names = [
            (n["role"]["value"], n.get("name", {}).get("value", ""))
            for n in tree
            if not n["ignored"] and n["role"]["value"] in CONTROLS
        ]
        assert len(names) > 40 and not [x for x in names if len(x[1]) < 2], (action, names)
        # Rows of a kind are groups that say which they are.
        groups = {n["name"]["value"] for n in tree if n.get("role", {}).get("value") == "group"}
        rows = page.js(
            f"document.querySelectorAll('#action-{action} .rows .row [aria-label=limb]').length"
        )
        assert not rows or {"Stay put 1", "Touch 1", "Touch 2"} <= groups, (action, groups)
        short = page.js(
            f"""[...document.querySelectorAll('#action-{action} .field select')].filter(e => {{
            const ink = document.createElement('canvas').getContext('2d');
            ink.font = getComputedStyle(e).font;
            const long = Math.max(...[...e.options].map(o => ink.measureText(o.text).width));
            return e.offsetParent && e.id !== 'rig-onto' && long + 30 > e.clientWidth;
            }}).map(e => e.id)"""
        )
        assert short == [], (action, short)
        assert page.js("[...document.querySelectorAll('*')].every(e => e.tabIndex <= 0)")
        if action != "body":
            continue
        page.js("document.activeElement.blur(); document.body.tabIndex = -1; document.body.focus()")
        seen = list[Any]()
        while True:
            press(page, "Tab")
            now = page.js(FOCUS)
            # After the last one it begins anew.
            if not now[0] or now in seen[:1]:
                break
            seen.append(now)
        parts = [part for part, *_ in seen]
        assert list(dict.fromkeys(parts)) == ["HEADER", "NAV", "MAIN", "ASIDE", "FOOTER"], action
        assert parts == sorted(parts, key=["HEADER", "NAV", "MAIN", "ASIDE", "FOOTER"].index), action
        for _, word, left, top, right, bottom, ring in seen:
            assert left >= 0 and top >= 0 and right <= 1280 and bottom <= 720, (action, word)
            assert ring != "none", (action, word)
    assert page.js("document.documentElement.scrollWidth") == 1280
    for side in ("aside", "nav"):
        name = f"document.querySelector('{side}')"
        assert page.js(f"{name}.scrollWidth - {name}.clientWidth") == 0
    dark = [{"name": "prefers-color-scheme", "value": "dark"}]
    light = page.js("getComputedStyle(document.body).backgroundColor")
    page.call("Emulation.setEmulatedMedia", features=dark)
    assert page.js("getComputedStyle(document.body).backgroundColor") != light


def test_marks_of_the_timeline_by_keyboard(page: Page) -> None:
    """N and P go from fault to fault; the slider says what is there; keys turn the view."""
    choose(page, "video")
    page.js("document.getElementById('timeline').focus()")
    said = "document.getElementById('timeline').getAttribute('aria-valuetext')"
    order = page.js("poiseOpen.state.judged.faults.map(f => f.start).sort((a, b) => a - b)")
    press(page, "Home")
    for start in order[:3]:
        press(page, "n")
        assert page.js("poiseOpen.state.frame") == start
        assert "slides" in page.js(said) and f"frame {start} of 85" in page.js(said)
    press(page, "p")
    assert page.js("poiseOpen.state.frame") == order[1]
    press(page, "PageUp")
    assert page.js("poiseOpen.state.frame") == order[1] + 10
    x, _, depth = page.js("poiseOpen.screen(12)")
    press(page, ".")
    where = "poiseOpen.screen(12)"
    page.until(f"Math.abs({where}[0] - {x}) + Math.abs({where}[2] - {depth}) > 1e-4")
