"""How: the Dreamer writes an edit prompt for the interaction and has it painted.

T_sim = VLM(I, T; template)        I_sim = G(I, T_sim)        (arXiv 2512.14442, section 3.2)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from PIL.Image import Image

from a4agent import prompts
from a4agent.errors import RefusedAnswer, TruncatedAnswer, UnreadableAnswer
from a4agent.protocols import ChatRequest, EditRequest, ImageEditor, VisionLanguageModel
from a4agent.stages.recorder import Recorder
from a4agent.types import Imagination


@dataclass(frozen=True)
class Dreamer:
    """Imagines the interaction with a vision-language model and an image editor.

    Without `required`, the agent goes on without an imagination when the Dreamer fails, as the authors do.
    """

    vlm: VisionLanguageModel
    editor: ImageEditor
    prompts: str = "paper"
    seed: int = 0
    max_tokens: int = 512
    required: bool = False

    def imagine(
        self,
        image: Image,
        instruction: str,
        recorder: Recorder | None = None,
        on_step: Callable[[int, int], None] | None = None,
        retry: int = 0,
    ) -> Imagination:
        """The edit prompt and the edited picture; each `retry` has another seed.

        Raises:
            AnswerError: the VLM wrote no usable prompt.
            ProviderError: a model could not be asked.
        """
        recorder = recorder or Recorder()
        text = prompts.fill(prompts.load(self.prompts, "dreamer"), instruction)
        answer = recorder.ask("dreamer", self.vlm, ChatRequest(images=(image,), text=text, max_tokens=self.max_tokens))
        prompt = _clean(answer.text)
        if not prompt:
            if answer.finish_reason == "length":
                raise TruncatedAnswer(
                    f"{self.vlm.id} used all {self.max_tokens} tokens before writing an edit prompt;"
                    " raise dreamer.max_tokens"
                )
            raise UnreadableAnswer(f"{self.vlm.id} wrote an empty edit prompt for {instruction!r}")
        if _declines(prompt):
            raise RefusedAnswer(f"{self.vlm.id} declined to write an edit prompt for {instruction!r}: {prompt[:200]!r}")
        edited = recorder.ask(
            "dreamer", self.editor, EditRequest(image=image, prompt=prompt, seed=self.seed + retry, on_step=on_step)
        )
        return Imagination(prompt=prompt, image=edited.image)


def _clean(text: str) -> str:
    """The prompt without the fences and quotes that models add against instructions."""
    text = text.strip()
    if text.startswith("```"):
        text = text.strip("`").partition("\n")[2] or text.strip("`")
    return text.strip().strip("\"“”'").strip()


def _declines(prompt: str) -> bool:
    opening = prompt[:60].lower().replace("’", "'")
    return opening.startswith(("i'm sorry", "i am sorry", "sorry,", "i can't", "i cannot", "i'm unable", "i am unable"))
