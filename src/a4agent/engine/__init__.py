"""Many samples at once: every stage busy, nothing asked twice, nothing lost. `run` is the way in.

    for query, affordance in engine.run(agent, queries, settings=EngineSettings(cache="write")):
        ...

Concurrency lives in this package alone. Stages and experts are plain synchronous code; see docs/scaling.md.
"""

from a4agent.config import EngineSettings
from a4agent.engine.pipeline import run
from a4agent.engine.stats import Stats

__all__ = ["EngineSettings", "Stats", "run"]
