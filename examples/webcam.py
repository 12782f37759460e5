"""A webcam as a person of `poise live`: keypoints of an estimator, sent as lines of JSON over TCP.

    pip install mediapipe
    poise live --keypoints 8018
    python examples/webcam.py --model pose_landmarker_full.task

This is a process of its own: Poise neither installs nor runs an estimator. `pip install mediapipe`
downloads MediaPipe (Apache 2.0, about 20 MB) with OpenCV and Matplotlib. Its model file (9 MB) does not
come along: with --download this script fetches it once from `MODEL_URL` to where --model says, and
without it nothing is downloaded. The camera's pictures stay in this process; keypoints alone are sent.

Stand still for two seconds, your whole body in the picture, the camera level.
"""

from __future__ import annotations

import argparse
import json
import socket
import sys
import time
import urllib.request
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

MODEL_URL = (
    "https://storage.googleapis.com/mediapipe-models/pose_landmarker/pose_landmarker_full/float16/1/"
    "pose_landmarker_full.task"
)
#: MediaPipe's 33 landmarks, in its order.
NAMES = (
    "nose", "left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye",
    "right_eye_outer", "left_ear", "right_ear", "mouth_left", "mouth_right", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_pinky",
    "right_pinky", "left_index", "right_index", "left_thumb", "right_thumb", "left_hip", "right_hip",
    "left_knee", "right_knee", "left_ankle", "right_ankle", "left_heel", "right_heel",
    "left_foot_index", "right_foot_index",
)  # fmt: skip
#: Landmarks that are sent: those that Poise knows.
SENT = tuple(k for k, n in enumerate(NAMES) if k in (0, 7, 8) or 11 <= k <= 16 or k >= 23)
#: Below it a landmark counts as unseen.
SEEN = 0.5


def message(landmarks: Sequence[Any], time_s: float, person: str = "webcam") -> str:
    """World landmarks (m, y down, the hips in the origin) as a message of `poise live`.

    The estimator does not tell where the person is, so the lowest foot stands on the floor: jumps are
    lost, and whoever walks does so on the spot.
    """
    lowest = max(landmarks[k].y for k in range(27, 33))
    points = [[landmarks[k].x, landmarks[k].y - lowest, landmarks[k].z] for k in SENT]
    sure = [float(landmarks[k].visibility > SEEN) for k in SENT]
    told = {"v": 1, "type": "keypoints", "person": person, "time": time_s, "up": "-Y"}
    told |= {"names": [NAMES[k] for k in SENT], "points": points, "confidence": sure}
    return json.dumps(told)


def send(
    poses: Iterable[tuple[Sequence[Any], float]], host: str, port: int, token: str | None = None
) -> int:
    """Sends (landmarks, s) as they come; how many there were."""
    count = 0
    with socket.create_connection((host, port)) as to:
        for landmarks, time_s in poses:
            line = message(landmarks, time_s)
            if token is not None and count == 0:
                line = json.dumps({**json.loads(line), "token": token})
            to.sendall(line.encode() + b"\n")
            count += 1
    return count


def watched(model: Path, camera: int) -> Iterator[tuple[Sequence[Any], float]]:
    """What the estimator sees of one person, frame by frame."""
    # Only here, so that the rest needs none of it.
    import cv2  # type: ignore
    import mediapipe as mp  # type: ignore
    from mediapipe.tasks.python import BaseOptions, vision  # type: ignore

    options = vision.PoseLandmarkerOptions(
        base_options=BaseOptions(model_asset_path=str(model)), running_mode=vision.RunningMode.VIDEO
    )
    film, began = cv2.VideoCapture(camera), time.monotonic()
    with vision.PoseLandmarker.create_from_options(options) as estimator:
        while film.isOpened():
            good, picture = film.read()
            if not good:
                break
            now = time.monotonic() - began
            picture = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
            image = mp.Image(image_format=mp.ImageFormat.SRGB, data=picture)
            found = estimator.detect_for_video(image, int(1000 * now)).pose_world_landmarks
            if found:
                yield found[0], now


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, default=Path("pose_landmarker_full.task"))
    parser.add_argument(
        "--download", action="store_true", help="fetch the model file where it is missing"
    )
    parser.add_argument("--camera", type=int, default=0)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8018)
    parser.add_argument("--token", help="where poise live listens on another address")
    a = parser.parse_args()
    if not a.model.exists():
        if not a.download:
            raise SystemExit(f"There is no {a.model}. --download fetches 9 MB from {MODEL_URL}")
        sys.stdout.write(f"Downloading 9 MB from {MODEL_URL}\n")
        urllib.request.urlretrieve(MODEL_URL, a.model)
    send(watched(a.model, a.camera), a.host, a.port, a.token)


if __name__ == "__main__":
    main()
