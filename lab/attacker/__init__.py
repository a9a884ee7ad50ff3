"""What an attacker of the network does, for tests and measurements inside the lab: listen, change, repeat, flood."""
