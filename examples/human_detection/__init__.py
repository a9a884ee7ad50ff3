"""Human detection as a service: people in camera frames (plr_demo_interfaces/srv/DetectPeople)."""
