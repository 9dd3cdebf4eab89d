"""What the events and frames of a pixel say of its light, and how that is learned."""
