"""Recordings in which one physical effect is hidden, and the score of a workflow that has to name it.

Nothing in this folder imports the library under test.
"""
