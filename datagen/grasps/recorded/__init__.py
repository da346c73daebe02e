"""GraspXL's recorded motions, replayed by MANO or by a hand that stands in."""
