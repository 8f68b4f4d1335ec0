"""Hostile input at every border where data comes in: what is answered, what is refused, and never
anything else.
"""
