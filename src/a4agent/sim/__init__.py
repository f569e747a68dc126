"""Scenes with exact truth: things from simulator packages, rendered on this machine.

`catalogue.toml` declares what can be handled and how a person would ask for it; `catalogue` reads it,
`assets` finds the packages, `scene` puts a thing on a table among others, `appearance` varies it, `render`
takes the picture and the truth, `make` writes a set that `a4 bench sim` reads.
"""
