"""Teleoperation in the browser: a person makes a deviation, marks it, and completes the task all the same.

`session` records one trajectory, `pilot` turns held keys into control steps, `simulator_thread` owns the
simulator, `server` is the page's server, `store` what was saved, `write` the candidate dataset made from it.
`client` drives by script over the page's own websocket; `takeover` serves the interventions' mode `human`.
"""
