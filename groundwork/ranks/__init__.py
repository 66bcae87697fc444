"""The processes of a training over several GPUs, and what they tell each other."""
