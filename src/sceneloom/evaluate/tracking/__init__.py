"""How good a tracker is: HOTA, CLEAR and identities, by KITTI's rules or for boxes in space."""
