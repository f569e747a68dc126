"""The models behind the stages. A stage knows `a4agent.protocols` and nothing else."""
