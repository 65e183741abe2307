"""MA-TD3+BC and OMAR as one writes them first in PyTorch: a module per agent and head, one agent after the other,
minibatches indexed from tensors in memory. speed.py measures it beside ours."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import nn
from torch.nn import functional as F

from ringfence.logs.store import EpisodeStore


def updating(algorithm: str, store: EpisodeStore) -> Callable[[], None]:
    """What makes one update of all agents."""
    n, batch, gamma, tau = 3, 1024, 0.95, 0.01
    rows = len(store.actions)
    episode = store.episode_of_step
    here = torch.arange(rows) + torch.as_tensor(episode)
    seen = torch.as_tensor(store.observations, dtype=torch.float32)
    acted = torch.as_tensor(store.actions, dtype=torch.float32)
    paid = torch.as_tensor(store.rewards, dtype=torch.float32)
    d, a = seen.shape[-1], acted.shape[-1]

    def network(inputs: int, outputs: int, *last) -> nn.Module:
        layers = [nn.BatchNorm1d(inputs), nn.Linear(inputs, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU()]
        return nn.Sequential(*layers, nn.Linear(64, outputs), *last)

    agents = []
    for _ in range(n):
        actor, critics = network(d, a, nn.Tanh()), [network(d + a, 1) for _ in range(2)]
        targets = [network(d, a, nn.Tanh()), *[network(d + a, 1) for _ in range(2)]]
        for target, net in zip(targets, [actor, *critics]):
            target.load_state_dict(net.state_dict())
        parameters = [p for q in critics for p in q.parameters()]
        optimisers = torch.optim.Adam(actor.parameters(), 0.01), torch.optim.Adam(parameters, 0.01)
        agents.append((actor, critics, targets, optimisers))

    def value(critic: nn.Module, x, action):
        return critic(torch.cat([x, action], -1))[:, 0]

    def sampled(critic: nn.Module, x, actions):
        b, s, _ = actions.shape
        return value(critic, x.repeat_interleave(s, 0), actions.reshape(b * s, -1)).reshape(b, s)

    def update() -> None:
        for i, (actor, critics, targets, (of_actor, of_critics)) in enumerate(agents):
            pick = torch.randint(rows, (batch,))
            x, ahead = seen[here[pick], i], seen[here[pick] + 1, i]
            action, reward = acted[pick, i], paid[pick, i]
            with torch.no_grad():
                after = targets[0](ahead)
                goal = reward + gamma * torch.minimum(*[value(q, ahead, after) for q in targets[1:]])
            loss = sum(F.mse_loss(value(q, x, action), goal) for q in critics)
            if algorithm == "omar":
                drawn = torch.rand(batch, 10, a) * 2 - 1
                for q in critics:
                    spread = torch.logsumexp(sampled(q, x, drawn) + a * torch.log(torch.tensor(2.0)), 1)
                    loss = loss + 5.0 * (spread - value(q, x, action)).mean()
            of_critics.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_([p for q in critics for p in q.parameters()], 0.5)
            of_critics.step()
            own = actor(x)
            if algorithm == "omar":
                with torch.no_grad():
                    mean, deviation = torch.zeros(batch, a), torch.full((batch, a), 2.0)
                    for _ in range(3):
                        tried = (mean[:, None] + deviation[:, None] * torch.randn(batch, 10, a)).clamp(-1, 1)
                        q = sampled(critics[0], x, tried)
                        mean = (q.softmax(1)[..., None] * tried).sum(1)
                        deviation = ((tried - mean[:, None]) ** 2).mean(1).sqrt()
                    best = tried[torch.arange(batch), q.argmax(1)]
                    better = q.max(1).values > value(critics[0], x, own)
                    best = torch.where(better[:, None], best, own)
                loss = F.mse_loss(own, best)
            else:
                q = value(critics[0], x, own)
                loss = F.mse_loss(own, action) - 2.5 / q.abs().mean().detach() * q.mean()
            loss = loss + 1e-3 * (own**2).mean()
            of_actor.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(actor.parameters(), 0.5)
            of_actor.step()
            with torch.no_grad():
                for target, net in zip(targets, [actor, *critics]):
                    for p, q in zip(target.parameters(), net.parameters()):
                        p.lerp_(q, tau)

    return update
