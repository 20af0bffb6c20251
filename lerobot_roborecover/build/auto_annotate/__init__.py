"""Automatic annotators: written rules, applied to what the annotation page shows, with its keys alone.

For sets that nobody can be asked to label, such as the study that anyone re-runs. Their votes are marked as
automatic from the journal to the published provenance, and are no substitute for people's.

looking.py   what was read off the page; rules.py  what it is called; annotators.py  who differs in what
page.py      reads and presses keys in headless Chromium; run.py  server, browser, queue
"""
