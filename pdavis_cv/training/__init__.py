"""Train the recurrent networks on simulated events; needs torch.

Only ``pdavis train`` imports this package.
"""
