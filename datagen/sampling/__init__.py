"""All randomness between a grasp sequence and its images."""
