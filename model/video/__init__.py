"""Videos, images and clips to frames; frames to crops; results to images and films."""
