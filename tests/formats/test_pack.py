"""Clips as tensors and JSON, and back without loss."""

from __future__ import annotations

import json

import numpy as np
import pytest

from poise.formats import read_clip
from poise.formats.own import pack_clips, unpack_clips
from poise.motion import Channel, Clip, Source, trim
from refusals import refused
from toy_human import swing


def same(a: Clip, b: Clip) -> None:
    assert a.skeleton == b.skeleton, "The source with its channels is part of it."
    assert (a.name, a.fps, a.cyclic) == (b.name, b.fps, b.cyclic)
    np.testing.assert_array_equal(a.root_pos, b.root_pos)
    np.testing.assert_array_equal(a.rot, b.rot)


def round_trip(*clips: Clip) -> list[Clip]:
    tensors, notes = pack_clips(clips)
    return unpack_clips(tensors, json.loads(json.dumps(notes)))


def test_everything_comes_back_through_json():
    source = Source(
        "bvh",
        "a.bvh",
        0.01,
        "Y",
        (Channel(("Zrotation", "Xrotation"), (0.1, 0.2, 0.3), "XYZ", ((-1.0, 1.0), (0.0, 2.0))),),
        1 / 30,
        "Hips",
        notes=("a note",),
        extra=(("key", "value"),),
    )
    clip = swing(speed=1.0, cyclic=True, name="walk")
    clip = clip.replaced(skeleton=clip.skeleton.with_source(**vars(source)))
    back = round_trip(clip, swing())
    assert len(back) == 2
    same(back[0], clip)
    same(back[1], swing())
    assert hash(back[0].skeleton.source), "Tuples all the way down, so that it can be hashed."


@pytest.mark.parametrize("name", ["cmu_amc/02/02_01.amc", "other/mass_bvh/walk.bvh"])
def test_real_clips_come_back(data_dir, name):
    clip = trim(read_clip(data_dir / name), 0, 20)
    same(round_trip(clip)[0], clip)


@pytest.mark.parametrize("key", ["0/root_pos", "0/rot", "0/offsets"])
def test_a_missing_tensor_is_told(key):
    tensors, notes = pack_clips([swing()])
    del tensors[key]
    with refused("file-damaged", says=key):
        unpack_clips(tensors, notes)


@pytest.mark.parametrize("key", ["name", "fps", "parents", "source"])
def test_a_missing_note_is_told(key):
    tensors, notes = pack_clips([swing()])
    del notes[0][key]
    with refused("file-damaged", says=key):
        unpack_clips(tensors, notes)


@pytest.mark.parametrize(
    ("key", "value"),
    [("ends", "text"), ("name", ["a"]), ("fps", "fast"), ("source", []), ("names", [1]), ("parents", 3)],
)
def test_a_note_of_another_kind_is_told(key, value):
    tensors, notes = pack_clips([swing()])
    with refused("file-damaged"):
        unpack_clips(tensors, [{**notes[0], key: value}])
