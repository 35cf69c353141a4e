"""Studies: algorithms × kinds of tasks × seeds; what breaks an algorithm, and how sure we are."""
