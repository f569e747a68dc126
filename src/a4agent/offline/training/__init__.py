"""Makes the network that the offline experts see with: drawings with exact part truth, training, export.

python -m a4agent.offline.training        # what `make train` runs
"""
