"""The panel: a page in the browser that shows a mechanism live or from a recording, and lets one operate a run.

It is a process of its own, and reaches a run by its channel alone (`hil.runs.operator`).
"""
