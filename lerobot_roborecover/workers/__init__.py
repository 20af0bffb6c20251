"""One pool of simulator processes: fresh interpreters that import neither LeRobot nor torch, typed messages,
replacement of what dies or hangs, and no process that outlives its parent.

`slots` are the processes, `dispatch` keeps each of them busy, `jobs` runs functions in them; `messages` is
all that travels. What a worker serves is named by `SlotConfig.server`. `workplace` says whether they are here
or on a Ray cluster, and `cluster` puts them there.
"""
