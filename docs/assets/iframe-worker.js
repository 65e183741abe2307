/* Browsers refuse workers to pages that were opened from a folder. There, and only there, a worker's script runs in a
   hidden frame instead, so that the search works without a server. */
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      const frame = document.createElement("iframe")
      frame.hidden = true
      document.documentElement.appendChild(frame)
      const inside = frame.contentWindow
      const later = (target, data) => setTimeout(() => target.dispatchEvent(new MessageEvent("message", { data })))
      inside.postMessage = data => later(this, data)
      this.postMessage = data => this.ready.then(() => later(inside, data))
      this.terminate = () => frame.remove()
      this.ready = new Promise((resolve, reject) => {
        const script = inside.document.createElement("script")
        script.src = new URL(url, document.baseURI)
        script.onload = resolve
        script.onerror = reject
        inside.document.documentElement.appendChild(script)
      })
    }
    set onmessage(hear) { this.addEventListener("message", hear) }
    set onerror(hear) { this.addEventListener("error", hear) }
  }
}
