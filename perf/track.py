"""Following a part against grounding it in every frame, on rendered sequences with exact truth.

    python perf/track.py [--sequences 6] [--frames 40] [--profile offline]

The camera circles a thing of the simulator's dev split, half a degree a frame. J is the mean IoU over frames, as in
video segmentation; a lost frame counts 0. "from the true mask" shows the tracker alone, without errors of grounding.
Needs the simulator's assets and a renderer, as `a4 data make sim`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from PIL import Image

from a4agent import A4Agent
from a4agent.imaging.masks import iou
from a4agent.sim.backend import mujoco
from a4agent.sim.catalogue import built_in
from a4agent.sim.draw import Drawn, draw_sample, plan_set
from a4agent.sim.render import SceneRenderer
from a4agent.sim.scene import EYE
from a4agent.video.track import track
from a4agent.video.trackers import FlowTracker

DEGREES = 0.5


@dataclass
class Sequence:
    instruction: str
    frames: list[Image.Image]
    truths: list[np.ndarray]


def circled(drawn: Drawn, count: int) -> Iterator[tuple[Image.Image, np.ndarray]]:
    """Frames and true masks while the camera circles the thing's middle about the vertical."""
    scene = drawn.scene
    model = scene.model
    eye = model.camera(EYE).id
    position, quaternion = model.cam_pos[eye].copy(), model.cam_quat[eye].copy()
    geoms = np.concatenate(list(scene.part_geoms.values()))
    with SceneRenderer(scene, drawn.camera.wide_wh) as rendering:
        for number in range(count):
            angle = np.radians(DEGREES * number)
            turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
            about, turned = np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)]), np.zeros(4)
            mujoco().mju_mulQuat(turned, about, quaternion)
            model.cam_pos[eye] = scene.center + turn @ (position - scene.center)
            model.cam_quat[eye] = turned
            mujoco().mj_forward(model, scene.data)
            yield Image.fromarray(rendering.colour(drawn.camera)), np.isin(rendering.ids(drawn.camera), geoms)


def sequences(count: int, frames: int) -> Iterator[Sequence]:
    catalogue = built_in()
    for plan in plan_set(catalogue, count, 5, "dev"):
        pairs = list(circled(draw_sample(catalogue, plan), frames))
        yield Sequence(plan.task.say, [frame for frame, _ in pairs], [truth for _, truth in pairs])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--sequences", type=int, default=6)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--profile", default="offline")
    options = parser.parse_args()

    names = ("grounded in every frame", "tracked", "tracked from the true mask")
    scores: dict[str, list[float]] = {name: [] for name in names}
    calls = dict.fromkeys(names, 0)
    seconds = dict.fromkeys(names, 0.0)
    total = 0
    with A4Agent.from_profile(options.profile, {"verifier": "off"}) as agent:
        for sequence in sequences(options.sequences, options.frames):
            total += len(sequence.frames)
            started = time.perf_counter()
            masks = [agent.predict(frame, sequence.instruction).mask for frame in sequence.frames]
            scores[names[0]] += [iou(mask, truth) for mask, truth in zip(masks, sequence.truths, strict=True)]
            seconds[names[0]] += time.perf_counter() - started
            calls[names[0]] += len(masks)

            started = time.perf_counter()
            stream = enumerate(sequence.frames)
            for found in track(agent, stream, sequence.instruction, FlowTracker()):
                scores[names[1]].append(iou(found.mask, sequence.truths[found.index]))
                calls[names[1]] += found.affordance is not None
            seconds[names[1]] += time.perf_counter() - started

            started = time.perf_counter()
            tracker = FlowTracker()
            tracker.start(sequence.frames[0], sequence.truths[0])
            scores[names[2]].append(1.0)
            for frame, truth in zip(sequence.frames[1:], sequence.truths[1:], strict=True):
                scores[names[2]].append(iou(tracker.step(frame).mask, truth))
            seconds[names[2]] += time.perf_counter() - started
            print(f"  {sequence.instruction}: " + ", ".join(f"{np.mean(scores[n][-len(masks) :]):.2f}" for n in names))
    print(f"\n{options.sequences} sequences of {options.frames} frames, profile {options.profile!r}\n")
    print("| | J | calls of the agent | frames a second |\n|---|---|---|---|")
    for name in names:
        print(f"| {name} | {np.mean(scores[name]):.3f} | {calls[name]} | {total / seconds[name]:.1f} |")


if __name__ == "__main__":
    main()
