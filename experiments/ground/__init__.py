"""Study the wheel with unilateral contact, and what simpler models miss."""
