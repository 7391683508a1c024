'use strict';
(() => {
  const byId = id => document.getElementById(id);
  const scene = JSON.parse(byId('view3d-scene').textContent);
  const details = byId('view3d'), plot = byId('view3d-plot'), time = byId('view3d-time'), play = byId('view3d-play');
  const dark = matchMedia('(prefers-color-scheme: dark)');
  const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  // A sphere of rings; every ellipsoid of the body is one.
  const RINGS = 6, AROUND = 8, sphere = [], faces = [];
  for (let r = 0; r <= RINGS; r++) {
    for (let a = 0; a < AROUND; a++) {
      const up = Math.PI * r / RINGS, turn = 2 * Math.PI * a / AROUND;
      sphere.push([Math.sin(up) * Math.cos(turn), Math.cos(up), Math.sin(up) * Math.sin(turn)]);
      if (r < RINGS) {
        const here = r * AROUND + a, next = r * AROUND + (a + 1) % AROUND;
        faces.push([here, next, here + AROUND], [next, next + AROUND, here + AROUND]);
      }
    }
  }

  function body(instant) {
    const out = { x: [], y: [], z: [], i: [], j: [], k: [] };
    for (const [node, cx, cy, cz, rx, ry, rz] of scene.body) {
      const base = out.x.length;
      const [qx, qy, qz, qw] = instant.turns.slice(4 * node, 4 * node + 4);
      const [px, py, pz] = instant.nodes.slice(3 * node, 3 * node + 3);
      for (const [ux, uy, uz] of sphere) {
        const x = cx + rx * ux, y = cy + ry * uy, z = cz + rz * uz;
        const tx = 2 * (qy * z - qz * y), ty = 2 * (qz * x - qx * z), tz = 2 * (qx * y - qy * x);
        out.x.push((px + x + qw * tx + qy * tz - qz * ty) / 1000);
        out.y.push((py + y + qw * ty + qz * tx - qx * tz) / 1000);
        out.z.push((pz + z + qw * tz + qx * ty - qy * tx) / 1000);
      }
      for (const [a, b, c] of faces) { out.i.push(base + a); out.j.push(base + b); out.k.push(base + c); }
    }
    return out;
  }

  function points(flat) {
    const out = { x: [], y: [], z: [] };
    for (let k = 0; k < flat.length; k += 3) {
      out.x.push(flat[k] / 1000); out.y.push(flat[k + 1] / 1000); out.z.push(flat[k + 2] / 1000);
    }
    return out;
  }

  function bones(instant, side) {
    const out = { x: [], y: [], z: [] };
    for (const [from, to, which] of scene.bones) {
      if (which !== side) continue;
      for (const node of [from, to]) {
        out.x.push(instant.nodes[3 * node] / 1000);
        out.y.push(instant.nodes[3 * node + 1] / 1000);
        out.z.push(instant.nodes[3 * node + 2] / 1000);
      }
      out.x.push(null); out.y.push(null); out.z.push(null);
    }
    return out;
  }

  function traces(instant) {
    const line = (name, side, tone) => ({
      type: 'scatter3d', mode: 'lines', name, hoverinfo: 'name', line: { width: 7, color: colour(tone) }, ...bones(instant, side),
    });
    const all = [
      { type: 'mesh3d', name: 'body', showlegend: true, hoverinfo: 'skip', opacity: 0.2, color: colour('--c6'), lighting: { ambient: 0.9, diffuse: 0.2, specular: 0 }, ...body(instant) },
      line('left', 0, '--c0'), line('right', 1, '--c1'), line('trunk', 2, '--ink'),
    ];
    if (scene.instants.some(i => i.cloud.length > 0)) {
      all.push({
        type: 'scatter3d', mode: 'markers', name: 'cloud', hoverinfo: 'skip', marker: { size: 2.2, color: colour('--c2') }, ...points(instant.cloud),
      });
    }
    return all;
  }

  // The same room in all frames.
  const room = [0, 1, 2].map(axis => {
    let low = Infinity, high = -Infinity;
    for (const instant of scene.instants) {
      for (let k = axis; k < instant.nodes.length; k += 3) {
        low = Math.min(low, instant.nodes[k]); high = Math.max(high, instant.nodes[k]);
      }
    }
    return [low / 1000 - 0.25, high / 1000 + 0.25];
  });

  // Metres are as long in all directions, whatever the room's shape.
  const lengths = room.map(([low, high]) => high - low), mean = Math.cbrt(lengths[0] * lengths[1] * lengths[2]);
  const aspect = { x: lengths[0] / mean, y: lengths[1] / mean, z: lengths[2] / mean };

  function layout() {
    const axis = (name, k) => ({
      title: { text: name + ' (m)' }, range: room[k], color: colour('--soft'), gridcolor: colour('--line'), zeroline: false,
      showbackground: false, showspikes: false,
    });
    const vector = v => ({ x: v[0], y: v[1], z: v[2] });
    return {
      margin: { l: 0, r: 0, t: 0, b: 0 }, paper_bgcolor: 'rgba(0,0,0,0)', font: { color: colour('--ink'), family: 'system-ui, sans-serif', size: 12 },
      legend: { orientation: 'h', x: 0, y: 1, bgcolor: 'rgba(0,0,0,0)' }, uirevision: 'same',
      modebar: { bgcolor: 'rgba(0,0,0,0)', color: colour('--soft'), activecolor: colour('--ink') },
      scene: {
        aspectmode: 'manual', aspectratio: aspect, uirevision: 'same', xaxis: axis('x', 0), yaxis: axis('y', 1), zaxis: axis('z', 2),
        camera: { up: vector(scene.up), eye: vector(scene.eye) },
      },
    };
  }

  let shown = -1;
  function show() {
    shown = Math.min(Math.max(Number(time.value), 0), scene.instants.length - 1);
    const instant = scene.instants[shown];
    byId('view3d-label').textContent = instant.label;
    const config = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ['resetCameraLastSave3d', 'tableRotation'] };
    return Plotly.react(plot, traces(instant), layout(), config).then(() => { plot.dataset.frame = String(shown); });
  }

  details.addEventListener('toggle', () => {
    if (!details.open || shown >= 0 || scene.instants.length === 0) return;
    const script = document.createElement('script');
    script.textContent = byId('view3d-library').textContent;
    document.head.append(script);
    show();
  });
  time.addEventListener('input', () => { if (shown >= 0) show(); });
  dark.addEventListener('change', () => { if (shown >= 0) show(); });

  let playing = null;
  play.addEventListener('click', () => {
    if (playing !== null) { clearInterval(playing); playing = null; play.textContent = 'Play'; return; }
    play.textContent = 'Stop';
    playing = setInterval(() => {
      time.value = String((Number(time.value) + 1) % scene.instants.length);
      show();
    }, 120);
  });
})();
