"""The profiles that come with the package: complete, loadable, and the paper's where they say so."""

from __future__ import annotations

import pytest

from a4agent.agent import A4Agent
from a4agent.config import load_settings, profile_names
from a4agent.errors import ConfigError, MissingExtraError
from a4agent.experts import registry
from a4agent.requirements import EXTRAS, extras_of

WANTED = {
    "offline", "paper", "paper-open", "without-dreamer", "spotter-only", "paper-sam2-base-plus", "paper-sam2-tiny",
    "affordance-r1", "vision-reasoner", "seg-zero", "qwen2.5-vl", "internvl3", "grounding-dino",
    "modern", "api", "small",
}  # fmt: skip


def load(name):
    return load_settings(name, environ={})


def test_all_profiles_are_there():
    assert set(profile_names()) >= WANTED


@pytest.mark.parametrize("name", profile_names())
def test_a_profile_says_what_it_is_and_its_settings_exist(name):
    settings = load(name)
    info = settings.profile
    assert info.summary
    assert info.memory
    assert set(extras_of(settings.expert_specs())) <= set(EXTRAS)
    for role, spec in settings.expert_specs().items():
        inner = registry.inner_experts(spec.expert, spec.settings)
        for expert, own in [(spec.expert, spec.settings), *inner.values()]:
            known = registry.settings_of(registry.factory_of(registry.split(expert)[0]))
            assert known is None or set(own) <= set(known), f"{role} {expert}"


def experts(name):
    return {role: spec.expert for role, spec in load(name).expert_specs().items()}


def test_the_papers_system_is_the_papers():
    assert experts("paper") == {
        "dreamer.vlm": "openai:gpt-4o",
        "dreamer.editor": "qwen-image-edit:Qwen/Qwen-Image-Edit-2509",
        "thinker.vlm": "openai:gpt-4o",
        "spotter.detector": "rex-omni:IDEA-Research/Rex-Omni",
        "spotter.segmenter": "sam2:large",
    }
    settings = load("paper")
    assert settings.spotter.pairing == "paper"
    assert settings.dreamer.prompts == settings.thinker.prompts == "paper"


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("without-dreamer", {"dreamer": "off"}),
        ("spotter-only", {"dreamer": "off", "thinker": "off"}),
    ],
)
def test_an_ablation_is_the_paper_with_one_thing_off(name, overrides):
    overridden = load_settings("paper", overrides, environ={})
    profile = load(name)
    for stage in ("dreamer", "thinker", "spotter", "image", "engine"):
        assert getattr(profile, stage) == getattr(overridden, stage)


@pytest.mark.parametrize(
    ("name", "size"),
    [("paper-open-without-dreamer", "large"), ("paper-sam2-base-plus", "base-plus"), ("paper-sam2-tiny", "tiny")],
)
def test_the_ablation_of_components_is_the_open_paper_without_dreamer(name, size):
    overridden = load_settings("paper-open", {"dreamer": "off", "spotter.segmenter": f"sam2:{size}"}, environ={})
    profile = load(name)
    assert (profile.dreamer, profile.thinker, profile.spotter) == (None, overridden.thinker, overridden.spotter)


def test_the_open_paper_differs_in_its_vlm_only():
    vlm = "transformers:Qwen/Qwen2.5-VL-7B-Instruct"
    overridden = load_settings("paper", {"dreamer.vlm": vlm, "thinker.vlm": vlm}, environ={})
    profile = load("paper-open")
    assert (profile.dreamer, profile.thinker, profile.spotter) == (
        overridden.dreamer,
        overridden.thinker,
        overridden.spotter,
    )


@pytest.mark.parametrize("name", ["affordance-r1", "vision-reasoner", "seg-zero", "qwen2.5-vl", "internvl3"])
def test_a_baseline_grounds_the_instruction_itself(name):
    settings = load(name)
    assert settings.dreamer is None
    assert settings.thinker is None
    assert settings.spotter.detector.expert == f"vlm-grounding:{name}"
    tuned = name in ("affordance-r1", "vision-reasoner", "seg-zero")  # whose code loads SAM 2.0
    assert experts(name)["spotter.segmenter"] == ("sam2:facebook/sam2-hiera-large" if tuned else "sam2:large")


def test_modern_needs_no_non_commercial_model():
    from a4agent import requirements

    needs = requirements.needs(load("modern").expert_specs())
    assert all(need.info.licence == "Apache-2.0" and need.info.commercial for need in needs)


def test_api_needs_no_large_model_here():
    from a4agent import requirements

    assert sum(need.info.gigabytes or 9 for need in requirements.needs(load("api").expert_specs())) < 0.5


def test_providers_without_their_extra_say_so(monkeypatch):
    import importlib

    real = importlib.import_module

    def without_openai(name, *rest):
        if name == "openai":
            raise ModuleNotFoundError("No module named 'openai'", name="openai")
        return real(name, *rest)

    monkeypatch.setattr(importlib, "import_module", without_openai)
    monkeypatch.setenv("OPENAI_API_KEY", "x")
    with pytest.raises(MissingExtraError, match=r"pip install 'a4agent\[api\]'"):
        registry.create("openai:gpt-4o", "vlm")


def test_a_model_that_plays_two_roles_is_built_once(openai_server):
    vlm = {"expert": "openai:m", "base_url": openai_server.url}
    overrides = {
        "dreamer": "off",
        "thinker.vlm": vlm,
        "spotter.detector": {"expert": "vlm-grounding:qwen3-vl", "vlm": vlm},
        "spotter.segmenter": "off",
    }
    agent = A4Agent.from_settings(load_settings("modern", overrides, environ={}))
    assert agent.spotter.detector.vlm is agent.thinker.vlm
    agent.close()
    with pytest.raises(ConfigError, match="provider:model"):
        A4Agent.from_settings(load_settings("qwen2.5-vl", {"spotter.detector.vlm": "qwen"}, environ={}))
