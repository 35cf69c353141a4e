"""Profiles: where an algorithm breaks, on nine axes of the task, beside the reference algorithms.

`document` has the facts and what follows from them, `run` makes them, and `page` shows them.
"""
