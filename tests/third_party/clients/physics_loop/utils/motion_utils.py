"""A file of the client's own `utils` folder, which merges with the project's."""

import torch


def turn(positions, covariances, angle):
    """Positions (N,3) and packed covariances (N,6) after a turn about the z axis."""
    angle = torch.tensor(angle)
    R = torch.eye(3, device=positions.device)
    R[0, 0] = R[1, 1] = torch.cos(angle)
    R[1, 0], R[0, 1] = torch.sin(angle), -torch.sin(angle)
    full = torch.zeros((len(covariances), 3, 3), device=positions.device)
    rows, columns = torch.triu_indices(3, 3)
    full[:, rows, columns] = covariances
    full[:, columns, rows] = covariances
    turned = R @ full @ R.T
    return positions @ R.T, turned[:, rows, columns], R
