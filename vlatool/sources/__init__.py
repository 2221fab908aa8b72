"""Ways of obtaining a policy; each makes a bundle that the other stages start from."""
