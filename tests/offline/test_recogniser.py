"""The recogniser: which classes stand for a thing, and whether a marked place looks like what was asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from a4agent import A4Agent
from a4agent.files import read_toml
from a4agent.imaging.load import load_image
from a4agent.offline import recogniser
from a4agent.offline.knowledge import knowledge
from a4agent.offline.recogniser import Recognised, around, classes_of, labels, recognise
from a4agent.stages.recorder import Recorder
from a4agent.stages.signals import Evidence
from a4agent.stages.spotter import Spotter
from a4agent.testing import ScriptedDetector, ScriptedSegmenter
from a4agent.types import Affordance, Region, Target

COFFEE = Path(__file__).parents[2] / "examples" / "coffee.jpg"


def checks_of(name: str | None, mask: np.ndarray | None = None, phrase: str = "the rim") -> dict[str, float | None]:
    photo = load_image(COFFEE)
    if mask is None:
        mask = np.zeros((photo.height, photo.width), bool)
        mask[30:240, 185:440] = True  # the cup
    regions = (Region(None, np.zeros((0, 2), np.float32), mask),)
    target = None if name is None else Target("x", name, phrase)
    answer = Affordance(phrase, photo.size, target=target, regions=regions, image=photo)
    seen = Evidence(answer, Spotter(ScriptedDetector(), ScriptedSegmenter()), Recorder())
    return {check.name: check.value for check in Recognised().measure(seen)}


def test_every_class_and_thing_in_the_table_exists() -> None:
    tables = read_toml(Path(recogniser.__file__).with_name("recogniser.toml"))
    assert set(tables["things"]) <= set(knowledge().objects)
    assert len(labels()) == 1000
    for name in tables["things"]:
        itself, alike = classes_of(name)
        assert itself or alike, name


def names(numbers: list[int]) -> list[str]:
    return [labels()[number] for number in numbers]


@pytest.mark.parametrize(
    ("name", "itself", "alike"),
    [
        ("Mug", "coffee mug", "whiskey jug"),
        ("the screwdriver", "screwdriver", "ballpoint"),
        ("umbrella", "umbrella", None),
        ("whale", "grey whale", None),
        ("tennis racket", "racket", None),
    ],
)
def test_classes_of_a_thing(name: str, itself: str, alike: str | None) -> None:
    found = classes_of(name)
    assert itself in names(found[0])
    assert (alike in names(found[1])) if alike else not found[1]


def test_what_imagenet_lacks_is_measured_by_what_it_looks_like() -> None:
    assert classes_of("saw")[0] == []
    saw = checks_of("saw")
    assert saw["thing_itself"] is not None
    assert saw["thing_itself"] >= (saw["thing_alike"] or 0)  # the better of two views against their mean
    assert checks_of("object")["thing_itself"] is None


def test_a_thing_without_a_name_may_be_any_known_one_and_an_unknown_one_none() -> None:
    assert len(classes_of("object")[1]) > 200
    assert classes_of("frobnicator") == ([], [])
    assert checks_of("frobnicator") == {"thing_itself": None, "thing_alike": None}


def test_a_cup_is_recognised_and_nothing_else_is() -> None:
    cup = checks_of("cup")
    assert (cup["thing_itself"] or 0) > 0.9
    for other in ("hammer", "umbrella", "bicycle", "guitar", "chair", "knife"):
        found = checks_of(other)
        assert (found["thing_alike"] or 0) < 0.5, other
        assert (found["thing_itself"] or 0) < 0.5, other


def test_without_a_thinker_the_phrase_names_the_thing() -> None:
    assert checks_of(None, phrase="the rim of the cup") == checks_of("cup")
    assert checks_of(None, phrase="the part that can contain") == checks_of("object")


def test_a_blank_mask_has_no_value() -> None:
    photo = load_image(COFFEE)
    assert checks_of("cup", np.zeros((photo.height, photo.width), bool))["thing_alike"] is None


def test_probabilities_add_up_also_beyond_the_edge() -> None:
    boxes = np.array([[0, 0, 640, 427], [-300, -300, 100, 100]], np.float32)
    found = recognise(load_image(COFFEE), boxes)
    assert found.shape == (2, 1000)
    np.testing.assert_allclose(found.sum(1), 1, atol=1e-4)


def test_a_crop_larger_than_pillow_allows_is_as_sure() -> None:
    """Warnings are errors here, and Pillow warns of crops of over 89 megapixels."""
    photo, box = load_image(COFFEE), np.array([70, 10, 480, 390], np.float32)
    large = photo.resize((16 * photo.width, 16 * photo.height))
    once, again = recognise(photo, around(box, 1.6)[None])[0], recognise(large, around(16 * box, 1.6)[None])[0]
    assert again.argmax() == once.argmax()
    assert again.max() == pytest.approx(once.max(), abs=0.1)


def test_a_tiny_mask_is_looked_at_with_its_surroundings() -> None:
    assert around(np.array([10, 10, 12, 12], np.float32), 1.6).tolist() == [-13, -13, 35, 35]
    assert around(np.array([0, 0, 100, 50], np.float32), 2.0).tolist() == [-50, -75, 150, 125]


def test_the_profile_accepts_what_is_there_and_abstains_from_what_is_not() -> None:
    with A4Agent.from_profile("offline") as agent:
        there = agent.predict(COFFEE, "fill the cup")
        absent = [agent.predict(COFFEE, ask) for ask in ("drive the nail in with the hammer", "open the umbrella")]
        cautious = A4Agent.from_profile("offline", {"verifier.accept": 1.0}).predict(COFFEE, "fill the cup")
    assert (there.status, there.confidence is not None and there.confidence > 0.7) == ("ok", True)
    assert [answer.status for answer in absent] == ["abstained"] * 2
    assert all(answer.mask.any() and answer.confidence is not None and answer.confidence < 0.3 for answer in absent)
    assert (cautious.status, cautious.confidence) == ("abstained", there.confidence)
