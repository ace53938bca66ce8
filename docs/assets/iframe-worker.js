// The search runs in a worker, and browsers start none from the file system. There, a hidden frame takes its place.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(address) {
      super()
      this.waiting = []
      const frame = document.createElement("iframe")
      frame.hidden = true
      document.body.append(frame)
      const inner = (this.inner = frame.contentWindow)
      const load = source => new Promise((done, failed) => {
        const script = inner.document.createElement("script")
        script.src = source
        script.onload = done
        script.onerror = () => failed(new Error(`cannot load ${source}`))
        inner.document.body.append(script)
      })
      inner.importScripts = (...sources) => sources.reduce((ready, next) => ready.then(() => load(next)), Promise.resolve())
      inner.postMessage = data => {
        const event = new MessageEvent("message", { data })
        this.dispatchEvent(event)
        this.onmessage?.(event)
      }
      load(address).then(() => {
        this.ready = true
        this.waiting.forEach(data => this.deliver(data))
      })
    }
    deliver(data) {
      this.inner.dispatchEvent(new MessageEvent("message", { data }))
    }
    postMessage(data) {
      this.ready ? this.deliver(data) : this.waiting.push(data)
    }
    terminate() {
      this.inner.frameElement.remove()
    }
  }
}
