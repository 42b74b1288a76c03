"""Jobs from photographs: reads a capture, prepares its images, and writes a job that recovers a scene from them."""
