"""The models behind the stages. A stage knows the protocols of `experts.base` and nothing else."""
