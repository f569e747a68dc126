"""Scenes with exact truth: things from simulator packages, rendered on this machine.

`things.toml` declares what can be handled and how a person would ask for it; `things` reads it,
`assets` finds the packages, `scene` puts a thing on a table among others, `looks` varies it, `render`
takes the picture and the truth, `make` writes a set that `a4 bench sim` reads.
"""
