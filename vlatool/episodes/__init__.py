"""Episodes in a user's environment: played, judged, and recorded to train on."""
