"""What KITTI's folders of sweeps, images, labels and OXTS lines are as parts of a scene, whichever benchmark's."""
