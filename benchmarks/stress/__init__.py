"""Random and extreme scenes of boxes, judged by an independent solver: see ``__main__``."""
