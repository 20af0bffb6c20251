"""`roborecover curate annotate`: a local web page on which people mark recovery points, each alone and blind.

identity.py  what annotators call dataset and episodes, and in which order they see them
sheet.py     what the page shows of an episode
server.py    the answers; serve.py  the process
page/        HTML, script and style
"""
