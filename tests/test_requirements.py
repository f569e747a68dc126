"""Which checkpoints experts need: from profiles, settings, experts inside experts, folders."""

from __future__ import annotations

import sys

import pytest

from a4agent import requirements
from a4agent.config import ExpertSettings, load_settings, profile_names
from a4agent.errors import CredentialError, MissingExtraError, ModelFilesError, UnknownNameError
from a4agent.experts import hub, registry


@pytest.fixture(autouse=True)
def empty_cache(monkeypatch, tmp_path):
    """No model on this disk, and no hub."""
    monkeypatch.setattr(hub, "cached", lambda name, revision=None, file="": None)


def names(**experts: str | dict) -> list[str]:
    specs = {role: ExpertSettings.model_validate(spec) for role, spec in experts.items()}
    return [f"{need.name}/{need.file}".rstrip("/") for need in requirements.needs(specs)]


def test_short_names_names_and_experts_without_models():
    assert names(segmenter="sam2:tiny") == ["facebook/sam2.1-hiera-tiny"]
    assert names(segmenter="sam2:owner/mine") == ["owner/mine"]
    assert names(vlm="openai:gpt-4o", editor="openai-images:gpt-image-2") == []
    assert names(vlm="transformers:Qwen/Qwen3-VL-2B-Instruct") == ["Qwen/Qwen3-VL-2B-Instruct"]


def test_a_vlm_inside_a_detector_counts():
    assert names(detector="vlm-grounding:affordance-r1") == ["hqking/affordance-r1"]
    own = {"expert": "vlm-grounding:qwen3-vl", "vlm": "transformers:Qwen/Qwen3-VL-4B-Instruct"}
    assert names(detector=own) == ["Qwen/Qwen3-VL-4B-Instruct"]
    table = {"expert": "vlm-grounding:qwen3-vl", "vlm": {"expert": "openai:m", "base_url": "http://127.0.0.1:9/v1"}}
    assert names(detector=table) == []


def test_lightning_brings_its_file():
    found = names(editor={"expert": "qwen-image-edit:Qwen/Qwen-Image-Edit-2509", "lightning": 4})
    assert found[0] == "Qwen/Qwen-Image-Edit-2509"
    assert found[1].startswith("lightx2v/Qwen-Image-Lightning/")
    assert "4steps" in found[1]
    own = names(editor={"expert": "qwen-image-edit:Qwen/Qwen-Image-Edit-2509", "lora": "owner/lora/file.safetensors"})
    assert own[1] == "owner/lora/file.safetensors"


def test_one_model_in_two_roles_is_needed_once():
    specs = {role: ExpertSettings(expert="transformers:owner/vlm") for role in ("dreamer.vlm", "thinker.vlm")}
    (need,) = requirements.needs(specs)
    assert need.roles == ("dreamer.vlm", "thinker.vlm")


def test_a_folder_is_taken_as_it_is(tmp_path):
    specs = {"vlm": ExpertSettings(expert=f"transformers:{tmp_path}")}
    (need,) = requirements.needs(specs)
    assert need.path == tmp_path
    assert need.is_folder
    assert requirements.check(specs) == []


def test_a_missing_folder_is_reported_at_once(tmp_path):
    with pytest.raises(ModelFilesError, match="no folder"):
        names(vlm=f"transformers:{tmp_path / 'gone'}")


def test_a_pinned_revision_is_kept():
    specs = {"vlm": ExpertSettings.model_validate({"expert": "transformers:owner/vlm", "revision": "v2"})}
    assert requirements.needs(specs)[0].revision == "v2"


def test_check_asks_once_a_missing_model_and_names_them_all(monkeypatch):
    asked = []

    def reach(name, revision=None, file=""):
        asked.append(name)
        raise ModelFilesError(f"{name!r}: the hub could not be reached: `a4 models pull {name}`")

    monkeypatch.setattr(hub, "reach", reach)
    with pytest.raises(ModelFilesError) as caught:
        requirements.check(load_settings("small").expert_specs())
    assert len(asked) == 2
    for name in asked:
        assert name in str(caught.value)
    assert "a4 models pull Qwen/Qwen3-VL-2B-Instruct facebook/sam2.1-hiera-tiny" in str(caught.value)


def test_check_passes_on_that_a_model_is_gated(monkeypatch):
    def reach(name, revision=None, file=""):
        raise CredentialError(f"{name!r} is gated")

    monkeypatch.setattr(hub, "reach", reach)
    with pytest.raises(CredentialError, match="facebook/sam3"):
        requirements.check({"spotter.segmenter": ExpertSettings(expert="sam3:facebook/sam3")})


def test_check_names_extras_keys_and_models_at_once(monkeypatch):
    """Once each, in the order in which they are of use, and without asking the hub."""
    monkeypatch.setattr(hub, "reach", lambda *_: pytest.fail("the hub was asked"))
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    no_torch = requirements.Extra(("no_such_module_at_all",), "")
    monkeypatch.setattr(requirements, "EXTRAS", {**requirements.EXTRAS, "local": no_torch})
    with pytest.raises(MissingExtraError) as caught:
        requirements.check(load_settings("api").expert_specs())
    first, *lines = str(caught.value).splitlines()
    assert first == "3 things are missing here:"
    fixes = [line.rpartition(": ")[2] for line in lines]
    assert fixes == [
        "pip install 'a4agent[local]'",
        "export OPENAI_API_KEY=...",
        "a4 models pull facebook/sam2.1-hiera-tiny",
    ]
    assert "openai:gpt-5.4, openai-images:gpt-image-2" in lines[1]


def test_extras_are_those_of_the_experts_in_use():
    assert requirements.extras_of(load_settings("paper").expert_specs()) == ["api", "local"]
    assert requirements.extras_of(load_settings("offline").expert_specs()) == ["offline"]
    assert "quantisation" in requirements.extras_of(load_settings("laptop").expert_specs())
    own = {"expert": "vlm-grounding:qwen3-vl", "vlm": "openai:m"}
    assert requirements.extras_of({"detector": ExpertSettings.model_validate(own)}) == ["api"]


def test_check_returns_what_has_to_be_fetched(monkeypatch):
    monkeypatch.setattr(hub, "reach", lambda *_: None)
    missing = requirements.check({"spotter.segmenter": ExpertSettings(expert="sam2:tiny")})
    assert [(need.name, need.info.gigabytes) for need in missing] == [("facebook/sam2.1-hiera-tiny", 0.16)]


def test_a_revision_and_a_file_are_part_of_how_a_model_is_called():
    pinned = requirements.need("owner/vlm@v2")
    assert (pinned.name, pinned.revision, pinned.reference) == ("owner/vlm", "v2", "owner/vlm@v2")
    file = requirements.need("owner/lora/sub/file.safetensors")
    assert (file.name, file.file, file.reference) == ("owner/lora", "sub/file.safetensors", file.name + "/" + file.file)
    specs = {"vlm": ExpertSettings.model_validate({"expert": "transformers:owner/vlm", "revision": "v2"})}
    assert requirements.needs(specs)[0].reference == "owner/vlm@v2"


def test_the_terms_are_one_line():
    assert requirements.need("facebook/sam3").terms.startswith("about 3.4 GB, SAM License, gated")
    assert "non-commercial" in requirements.need("IDEA-Research/Rex-Omni").terms
    assert requirements.need("owner/unknown").terms == "licence unknown here: see the model's page"


def test_an_external_expert_can_declare_its_checkpoints(monkeypatch):
    def factory(model, role):
        return None

    module = type("module", (), {"checkpoints": staticmethod(lambda model, settings: [f"stranger/{model}"])})
    monkeypatch.setitem(sys.modules, factory.__module__, module)
    monkeypatch.setitem(registry.plugins.added, "stranger", factory)
    assert names(detector="stranger:eye") == ["stranger/eye"]


def test_unknown_providers_are_answered():
    with pytest.raises(UnknownNameError, match="sam2"):
        names(segmenter="samm2:tiny")


def test_every_model_of_every_profile_is_in_the_catalogue():
    for profile in profile_names():
        for need in requirements.needs(load_settings(profile, environ={}).expert_specs()):
            assert need.name in requirements.catalogue(), f"{profile}: {need.name}"
            assert need.info.gigabytes
            assert need.info.licence


def test_every_licence_is_named_or_marked_as_unstated():
    licences = [model.licence for model in requirements.catalogue().values()]
    licences += [licence for name in profile_names() for licence in load_settings(name).profile.licences]
    assert [licence for licence in licences if "page" in licence or not licence] == []


def test_a_model_that_brings_code_says_so_before_it_is_fetched():
    need = requirements.need("tiiuae/Falcon-Perception")
    assert "Python code that runs with trust_remote_code = true" in need.terms
    assert "*.py" in hub.patterns("tiiuae/Falcon-Perception")
    assert "*.py" not in hub.patterns("facebook/sam3")
