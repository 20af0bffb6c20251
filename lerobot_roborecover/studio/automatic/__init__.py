"""Automatic annotators at the annotation page, with its keys alone.

For sets that nobody can be asked to label, such as the study that anyone re-runs. Their votes are marked as
automatic from the journal to the published provenance, and are no substitute for people's.

page.py  reads and presses keys in headless Chromium; run.py  server, browser, queue
"""
