"""What doctor.py looks at: the environment, a dataset, a trained model. Each check gives lines; nothing is changed."""
