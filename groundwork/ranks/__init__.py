"""The processes of a training over several GPUs, and their communication."""
