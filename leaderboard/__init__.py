"""The leaderboard: submissions of policies, every number of which is recomputed here.

    submission → verification → scores → ranking → pages

An open board proves performance, never learning: specs are public, so anyone can compute π*.
"""
