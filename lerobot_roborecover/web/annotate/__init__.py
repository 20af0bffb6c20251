"""`roborecover curate annotate`: a local web page on which people mark recovery points, each alone and blind.

queue.py     who sees what when; identity.py  what annotators call dataset and episodes
sheet.py     what is told of an episode
server.py    the answers; serve.py  the process
page/        HTML, script and style
"""
