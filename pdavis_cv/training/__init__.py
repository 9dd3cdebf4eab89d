"""Training of the recurrent networks on simulated events; needs torch.

Nothing in the package imports this room; ``pdavis train`` does.
"""
