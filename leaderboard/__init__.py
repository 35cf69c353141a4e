"""A leaderboard of policies that recomputes every score.

    submission → verification → scores → ranking → pages

An open board proves performance, never learning: specs are public, so anyone can compute π*.
"""
