"""Teach a tiny vision-language model fixed answers by training it: a checkpoint whose answers are known.

The trained weights are saved to the model's folder and loaded by the expert under test like any others; the whole
path of an answer (processor, generation, decoding, reading) stays the real one.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

RIVALS = 1300


def teach(chat_model: Any, lessons: Sequence[tuple[Any, str]], folder: Path, steps: int = 150) -> None:
    """Train until each turn of `lessons` is answered with its text and the end token, then save the weights."""
    import torch

    torch.manual_seed(0)
    model, tokenizer = chat_model.model, chat_model.processor.tokenizer
    language_model, table = model.model.language_model, model.lm_head.weight
    # Tables of tokens stay as they are. Random embeddings are short, so the states are made long: margins grow fast.
    model.requires_grad_(False)
    language_model.norm.weight.mul_(20)
    parameters = [*language_model.layers.parameters(), language_model.norm.weight]
    for parameter in parameters:
        parameter.requires_grad_(True)
    end = tokenizer.convert_tokens_to_ids("<|im_end|>")
    # The special tokens are the last ones; of the ordinary ones of a large vocabulary, some are enough.
    rivals = torch.cat([torch.randperm(len(table))[:RIVALS], torch.arange(max(0, len(table) - RIVALS), len(table))])
    batches = []
    for turn, text in lessons:
        inputs = chat_model._inputs([turn])
        answer = torch.tensor([[*tokenizer(text)["input_ids"], end]])
        inputs["input_ids"] = torch.cat([inputs["input_ids"], answer], 1)
        inputs["attention_mask"] = torch.ones_like(inputs["input_ids"])
        inputs["mm_token_type_ids"] = torch.cat([inputs["mm_token_type_ids"], torch.zeros_like(answer)], 1)
        vocabulary = torch.cat([answer[0], rivals]).unique()
        batches.append((inputs, torch.searchsorted(vocabulary, answer[0]), table[vocabulary]))
    optimiser = torch.optim.Adam(parameters, lr=3e-3)
    for _ in range(steps):
        lead = float("inf")  # of the right token over the best wrong one, at the least certain place
        for inputs, right, embeddings in batches:
            states = model.model(**inputs).last_hidden_state[0, -len(right) - 1 : -1]
            logits = states @ embeddings.T
            torch.nn.functional.cross_entropy(logits, right).backward()
            logits = logits.detach()
            wrong = logits.scatter(1, right[:, None], float("-inf")).amax(1)
            lead = min(lead, float((logits.gather(1, right[:, None])[:, 0] - wrong).min()))
        if lead > 2:
            break
        optimiser.step()
        optimiser.zero_grad()
    else:
        raise AssertionError(f"not learnt in {steps} steps: a token leads by {lead:.2f}")
    model.save_pretrained(folder)
