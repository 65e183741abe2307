"use strict";
(function () {
  const variable = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const redraws = [];

  function start(box) {
    const recording = JSON.parse(document.getElementById(box.dataset.source).textContent)[+box.dataset.index];
    const canvas = box.querySelector("canvas"), ink = canvas.getContext("2d");
    const play = box.querySelector(".play"), scrub = box.querySelector(".scrub"), status = box.querySelector(".status");
    const episode = box.querySelector(".episode"), speed = box.querySelector(".speed"), toggle = box.querySelector(".plans");
    const n = recording.agents;
    const chosen = () => recording.episodes[+episode.value];
    let now = 0, playing = false, last = 0;

    const at = (e, t, i) => {
      const s = Math.min(Math.floor(t), e.steps), w = t - s;
      const a = e.positions[s][i], b = e.positions[Math.min(s + 1, e.steps)][i];
      return [(a[0] * (1 - w) + b[0] * w) * e.unit, (a[1] * (1 - w) + b[1] * w) * e.unit];
    };

    function touching(points, charged) {  // by distance where bodies have a radius, else by what each was charged
      const hit = new Array(n).fill(false);
      for (const i of charged || []) hit[i] = true;
      if (!recording.contact) return hit;
      for (let i = 0; i < n; i++) for (let j = i + 1; j < n; j++)
        if (Math.hypot(points[i][0] - points[j][0], points[i][1] - points[j][1]) < recording.contact) hit[i] = hit[j] = true;
      return hit;
    }

    function draw() {
      const size = Math.max(1, Math.round(canvas.clientWidth * (window.devicePixelRatio || 1)));
      if (canvas.width !== size) canvas.width = canvas.height = size;
      const e = chosen(), scale = size / (2 * e.reach), unit = size / 560;
      const X = (x) => size / 2 + x * scale, Y = (y) => size / 2 - y * scale;
      const dark = variable("--ink"), rule = variable("--rule"), danger = variable("--danger");
      const colours = [0, 1, 2, 3, 4, 5, 6].map((c) => variable("--c" + c));
      ink.clearRect(0, 0, size, size);
      ink.lineJoin = ink.lineCap = "round";
      ink.strokeStyle = rule;
      ink.lineWidth = 1.2 * unit;
      const half = recording.arena || e.reach;
      ink.strokeRect(X(-half), Y(half), 2 * half * scale, 2 * half * scale);
      ink.strokeStyle = dark;
      ink.lineWidth = 2 * unit;
      for (const mark of e.landmarks) {
        const x = X(mark[0] * e.unit), y = Y(mark[1] * e.unit), r = 6 * unit;
        ink.beginPath();
        ink.moveTo(x - r, y - r); ink.lineTo(x + r, y + r); ink.moveTo(x - r, y + r); ink.lineTo(x + r, y - r);
        ink.stroke();
      }
      const points = [];
      for (let i = 0; i < n; i++) points.push(at(e, now, i));
      for (let i = 0; i < n; i++) {  // trails
        ink.strokeStyle = colours[i % 7];
        ink.globalAlpha = 0.45;
        ink.lineWidth = 1.6 * unit;
        ink.setLineDash([3 * unit, 4 * unit]);
        ink.beginPath();
        for (let s = 0; s <= Math.floor(now); s++) { const [x, y] = at(e, s, i); s ? ink.lineTo(X(x), Y(y)) : ink.moveTo(X(x), Y(y)); }
        ink.lineTo(X(points[i][0]), Y(points[i][1]));
        ink.stroke();
        ink.setLineDash([]);
      }
      const done = Math.floor(now + 1e-6);
      const hit = touching(points, e.charged && e.charged[done]);
      const bodySize = recording.radius ? recording.radius * scale : 8 * unit;
      for (let i = 0; i < n; i++) {  // bodies
        const colour = hit[i] ? danger : colours[i % 7];
        ink.beginPath();
        ink.arc(X(points[i][0]), Y(points[i][1]), bodySize, 0, 2 * Math.PI);
        ink.globalAlpha = hit[i] ? 0.5 : 0.22;
        ink.fillStyle = colour;
        ink.fill();
        ink.globalAlpha = 1;
        ink.strokeStyle = colour;
        ink.lineWidth = (hit[i] ? 3.5 : 2) * unit;
        ink.stroke();
      }
      if (e.plans && toggle.checked) {
        const drawn = e.plans[Math.min(Math.floor(now), e.steps - 1)];
        for (let q = drawn.length - 1; q >= 0; q--) for (let i = 0; i < n; i++) {  // the chosen plan, the first, on top
          const followed = q === 0, path = drawn[q].map((row) => [X(row[i][0] * 1e-3), Y(row[i][1] * 1e-3)]);
          ink.globalAlpha = followed ? 1 : 0.3;
          ink.lineWidth = (followed ? 2.6 : 1.2) * unit;
          ink.strokeStyle = ink.fillStyle = colours[i % 7];
          ink.beginPath();
          for (const [x, y] of path) ink.lineTo(x, y);
          ink.stroke();
          if (followed) {
            ink.beginPath();
            ink.arc(...path[path.length - 1], 3.4 * unit, 0, 2 * Math.PI);
            ink.fill();
          }
        }
      }
      ink.globalAlpha = 1;
      ink.fillStyle = dark;
      ink.font = `600 ${Math.round(13 * unit)}px system-ui, sans-serif`;
      ink.textAlign = "center";
      ink.textBaseline = "middle";
      for (let i = 0; i < n; i++) ink.fillText(String(i), X(points[i][0]), Y(points[i][1]));
      let reward = 0, cost = 0;
      for (let s = 0; s < done; s++) { reward += e.rewards[s]; cost += e.costs[s]; }
      const latest = done ? `reward ${e.rewards[done - 1].toFixed(1)}, so far ${reward.toFixed(1)}` : "reward –";
      status.textContent = `step ${done} of ${e.steps}  ·  ${latest}  ·  cost ${cost.toFixed(0)}  `;
      const unsafe = recording.contact ? hit.some(Boolean) : done && e.costs[done - 1] > 0;
      if (unsafe) {
        const b = document.createElement("b");
        b.textContent = recording.contact ? "contact" : "unsafe";
        status.append(b);
      }
      scrub.setAttribute("aria-valuetext", `step ${done} of ${e.steps}`);
    }

    function show(on) {
      playing = on;
      play.textContent = on ? "Pause" : "Play";
      if (on) { last = performance.now(); requestAnimationFrame(tick); }
    }

    function tick(time) {
      if (!playing) return;
      const steps = chosen().steps;
      now = Math.min(steps, now + Math.max(0, time - last) / 1000 * speed.value);
      last = time;
      scrub.value = now;
      draw();
      if (now >= steps) show(false); else requestAnimationFrame(tick);
    }

    play.addEventListener("click", () => { if (!playing && now >= chosen().steps) now = 0; show(!playing); });
    scrub.addEventListener("input", () => { show(false); now = +scrub.value; draw(); });
    scrub.addEventListener("keydown", (event) => {  // whole steps from the keyboard
      const way = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
      if (!way) return;
      event.preventDefault();
      show(false);
      now = Math.min(chosen().steps, Math.max(0, way > 0 ? Math.floor(now + 1e-6) + 1 : Math.ceil(now - 1e-6) - 1));
      scrub.value = now;
      draw();
    });
    episode.addEventListener("change", () => { now = 0; scrub.max = chosen().steps; scrub.value = 0; draw(); });
    if (toggle) toggle.addEventListener("change", draw);
    redraws.push(draw);
    draw();
  }

  document.querySelectorAll(".player").forEach(start);
  const all = () => redraws.forEach((draw) => draw());
  window.addEventListener("resize", all);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", all);
})();
