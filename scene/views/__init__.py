"""Records that cameras are made of: from a dataset's views, or from the arguments that the reference's Camera takes."""
