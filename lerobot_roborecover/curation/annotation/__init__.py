"""Votes of annotators, what they are shown, and the rules of the automatic ones.

votes.py   what was marked, durably; discussion.py  what goes to a further round
frames.py  episodes' frames as JPEG; traces.py  what is plotted; guide.py  definitions; examples.py  frames
naming.py  names for people of cameras and bodies; carried.py  what follows candidates into another dataset
shown.py   what is shown of an episode, and votes on it
looking.py what an automatic annotator has read; rules.py  what it is called; annotators.py  who differs how
automatic.py  has them vote
"""
