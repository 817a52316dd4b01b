"""What of a scene KITTI's folders can hold, and the files that they hold it in, whichever benchmark's."""
