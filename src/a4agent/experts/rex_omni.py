"""Rex-Omni in process."""

from __future__ import annotations

from a4agent.experts.rex_omni_answer import read_answer

__all__ = ["read_answer"]
