"""Views and their target images, captures with camera poses, and lens undistortion."""
