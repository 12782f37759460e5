"""Checkpoints: whole or not at all, and clear words for every wrong file."""

import json
from pathlib import Path

import pytest
import torch

from poise.learn import check_fits, checkpoint, load_checkpoint, save_checkpoint
from refusals import refused

TENSORS = {
    "a/weights": torch.arange(6.0).reshape(2, 3),
    "a/count": torch.tensor(3.5, dtype=torch.float64),
    "rng": torch.Generator().get_state(),
    "flags": torch.tensor([True, False]),
    "empty": torch.zeros(0, 4),
}
META = {"character": "abc", "num_obs": 76, "metadata": {"clips": ["walk"], "score": 0.1}}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "run" / "checkpoint.safetensors"
    save_checkpoint(path, TENSORS, META)
    return path


def test_round_trip(path):
    tensors, meta = load_checkpoint(path)
    assert tensors.keys() == TENSORS.keys()
    for name, value in TENSORS.items():
        assert tensors[name].dtype == value.dtype and torch.equal(tensors[name], value), name
    assert {k: meta[k] for k in META} == META
    assert meta["format"] == checkpoint.FORMAT
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_views_and_shared_memory_can_be_saved(tmp_path):
    x = torch.arange(12.0).reshape(3, 4)
    save_checkpoint(tmp_path / "c", {"x": x, "column": x[:, 1], "t": x.T}, {})
    tensors, _ = load_checkpoint(tmp_path / "c")
    assert torch.equal(tensors["column"], x[:, 1]) and torch.equal(tensors["t"], x.T)


@pytest.mark.parametrize("keep", [0, 5, 100, -1])
def test_a_cut_file_is_refused(path, keep):
    path.write_bytes(path.read_bytes()[:keep])
    with refused("file-damaged", says="checkpoint.safetensors"):
        load_checkpoint(path)


def test_a_flipped_bit_is_noticed(path):
    data = bytearray(path.read_bytes())
    data[-20] ^= 1
    path.write_bytes(bytes(data))
    with refused("file-damaged"):
        load_checkpoint(path)


def test_foreign_files_are_refused(path):
    from safetensors.torch import save_file

    save_file({"x": torch.ones(2)}, path)
    with refused("file-damaged"):
        load_checkpoint(path)
    with refused("file-unreadable", says=("absent", "No such file")):
        load_checkpoint(path.parent / "absent")


def test_another_format_says_who_wrote_it(path, monkeypatch):
    monkeypatch.setattr(checkpoint, "FORMAT", 2)
    save_checkpoint(path, TENSORS, META)
    monkeypatch.undo()
    with refused("version-differs", says="format 2"):
        load_checkpoint(path)


@pytest.mark.parametrize(
    ("expected", "words"),
    [
        ({"character": "xyz"}, ("abc", "xyz")),
        ({"num_obs": 80}, ("76", "80")),
        ({"num_actions": 3}, ("None", "3")),
        ({"num_envs": 8}, ("num_envs", "8")),
    ],
)
def test_another_character_or_size_is_refused(expected, words):
    check_fits(META, "run", character="abc", num_obs=76, num_actions=None)
    with refused("checkpoint-unfit", says=words):
        check_fits(META, "run", **expected)


@pytest.mark.parametrize("moment", ["before the rename", "while writing", "killed before the rename"])
def test_a_crash_leaves_the_old_file(path, monkeypatch, moment):
    def crash(*_: object) -> None:
        raise RuntimeError("crash")

    if moment == "while writing":
        monkeypatch.setattr(checkpoint.os, "fsync", crash)
    else:
        monkeypatch.setattr(Path, "replace", crash)
    if moment.startswith("killed"):  # A killed process does not tidy up.
        monkeypatch.setattr(Path, "unlink", crash)
    with pytest.raises(RuntimeError, match="crash"):
        save_checkpoint(path, {"a": torch.zeros(1)}, {"new": True})
    monkeypatch.undo()
    tensors, meta = load_checkpoint(path)
    assert torch.equal(tensors["a/weights"], TENSORS["a/weights"]) and "new" not in meta
    left = [p for p in path.parent.iterdir() if p != path]
    assert len(left) == int(moment.startswith("killed"))
    checkpoint.remove_partial(path.parent)
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_full_disk_is_told_in_a_sentence(path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint.os, "fsync", full)
    with refused("cannot-write"):
        save_checkpoint(path, TENSORS, META)


def test_the_json_can_be_read_without_poise(path):
    from safetensors import safe_open

    with safe_open(path, "pt") as file:
        assert json.loads(file.metadata()["poise"])["character"] == "abc"
