"""Train the recurrent networks on simulated events; needs torch."""
