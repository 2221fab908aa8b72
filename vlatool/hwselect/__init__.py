"""Which hardware a policy needs: count the work of a bundle, and predict what a profile's board would take for it."""
