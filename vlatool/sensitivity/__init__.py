"""What each layer costs in accuracy when it is quantized."""
