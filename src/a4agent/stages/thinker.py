"""What: the Thinker looks at the picture, and at the imagined one if there is one, and names the part to act on.

The prompt asks for "### Thinking" (kept for people) and "### Output", a JSON object that is validated
here. An answer that cannot be used is re-asked with the reason, at most `reasks` times
(arXiv 2512.14442, section 3.3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from PIL.Image import Image

from a4agent import prompts
from a4agent.errors import TruncatedAnswer, UnreadableAnswer
from a4agent.protocols import ChatRequest, VisionLanguageModel
from a4agent.stages.recorder import Recorder
from a4agent.stages.target_json import TargetAnswer, read_target, thinking_in
from a4agent.types import Imagination, Target

QUOTED = 240
"""How much of an unusable answer an error quotes, in characters."""
REVISE = """

Your previous answer was "{part}". A check of what came of it says: {reason}
Think again, and answer in the output format above. Keep your answer only if you are sure of it."""
REASK = """

Your previous answer could not be used: {reason}.
Answer again, in the output format above, with a JSON object that has "task", "object_name" and "object_part"."""


@dataclass(frozen=True)
class Thinker:
    """Decides on the part with a vision-language model.

    With `structured`, the schema of the answer goes along for servers that can hold a model to it.
    """

    vlm: VisionLanguageModel
    prompts: str = "paper"
    max_tokens: int = 2048
    reasks: int = 2
    structured: bool = False

    def decide(
        self,
        image: Image,
        instruction: str,
        imagination: Imagination | None = None,
        recorder: Recorder | None = None,
        rejected: tuple[str, str] | None = None,
    ) -> Target:
        """The target: task, object, part ("the handle of the mug") and the thinking behind it.

        `rejected` is a part that was answered before and what a check found wrong with it.

        Raises:
            AnswerError: no usable answer after all re-asks; the message holds the last reason.
            ProviderError: the model could not be asked.
        """
        recorder = recorder or Recorder()
        imagined = imagination.image if imagination else None
        template = "thinker" if imagined is not None else "thinker_one_image"
        question = prompts.fill(prompts.load(self.prompts, template), instruction)
        if rejected is not None:
            question += REVISE.format(part=rejected[0], reason=rejected[1])
        images = (image,) if imagined is None else (image, imagined)
        schema = TargetAnswer.model_json_schema() if self.structured else None
        text, reason, said, cut_off = question, "", "", False
        for attempt in range(self.reasks + 1):
            request = ChatRequest(images, text, schema=schema, max_tokens=self.max_tokens, attempt=attempt)
            answer = recorder.ask("thinker", self.vlm, request)
            try:
                target = read_target(answer.text)
            except UnreadableAnswer as error:
                said, cut_off = thinking_in(answer.text), answer.finish_reason == "length"
                reason = f"it was cut off after {self.max_tokens} tokens" if cut_off else str(error)
                text = question + REASK.format(reason=reason)
                continue
            return replace(target, task=target.task or instruction, thinking=target.thinking or answer.reasoning)
        times = "once" if self.reasks == 0 else f"{self.reasks + 1} times"
        asked = f"{self.vlm.id} gave no usable answer to {instruction!r} when asked {times}"
        asked += f": it said {said[:QUOTED].strip()!r} ({reason})" if said else f": {reason}"
        if cut_off:
            raise TruncatedAnswer(f"{asked}; raise thinker.max_tokens")
        raise UnreadableAnswer(asked)
